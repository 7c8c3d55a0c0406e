"""The page in other languages: no sentence is missing, none is left over, and none is written past the tables."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from string import Formatter
from typing import Any

import pytest
from jinja2 import Environment, nodes
from playwright.sync_api import Page, expect

from machines.profile import _ON_HOLD, _ON_LOST_LINK, load_profile, profile_names
from phrases.phrase import Phrase, phrases_in, restore, say
from service.job.spec.finish_library import built_in_sentences
from service.page.files import FOLDER
from service.server.schemas.estimates import ESTIMATE_EXAMPLE
from tests.levels import mostly_thorough
from tests.page import canned_job, machine_states
from tests.page.browser import layout_faults, open_blank
from tests.page.conftest import Opened
from tests.page.test_screens import FAULT, LONG_NAME, SCREENS, SIZES, Screen

TOP = Path(__file__).parents[2]
TEMPLATES = TOP / "service/job/report/templates"
OF_PAGE, OF_SERVER = (
    {path.stem: json.loads(path.read_text("utf-8")) for path in sorted(FOLDER.glob(f"languages/{names}"))}
    for names in ("*.json", "server/*.json")
)
TABLES = {language: OF_PAGE[language] | OF_SERVER[language] for language in OF_PAGE}
STARTS = re.compile(r"""(?<![\w.$])t(?:\(\s*("(?:[^"\\]|\\.)*")|`)""")
PLACEHOLDER = re.compile(r"\{\w+\}")
QUICK = ("job-planned",)


def of_a_machine_watched(state: str) -> Screen:
    def screen(opened: Opened) -> Page:
        page = open_blank(opened, "machine")
        machine_states.told(page, state)
        page.evaluate(f"location.hash = '#/machines/{machine_states.NAME}'")
        expect(page.locator(".step")).not_to_have_text("")
        return page

    return screen


SHOWN = SCREENS | {f"watched-{state}": of_a_machine_watched(state) for state in machine_states.STATES}

# In place of the German table: its entries in English, each between two letters that nobody sees and that playwright
# leaves out of what it compares; what stands in for a placeholder is outside of them.
MARKED = """
Object.defineProperty(navigator, "languages", { get: () => ["de-AT"] });
const load = window.fetch;
window.fetch = async (path, ...how) => {
    const answer = await load(path, ...how);
    if (!String(path).endsWith("/de.json")) return answer;
    const mark = (key) => `\\u200b${key.replaceAll(/\\{\\w+\\}/g, "\\u00ad$&\\u200b")}\\u00ad`;
    return Response.json(Object.fromEntries(Object.keys(await answer.json()).map((key) => [key, mark(key)])));
};
"""
UNMARKED = """() => {
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    const found = [];
    while (walk.nextNode()) {
        const inside = walk.currentNode.parentElement.closest("code, pre, kbd, noscript, footer option");
        if (!inside) found.push(walk.currentNode.data);
    }
    for (const name of ["title", "aria-label", "placeholder", "alt", "aria-valuetext"])
        for (const one of document.querySelectorAll(`body [${name}]`)) found.push(one.getAttribute(name));
    found.push(document.title);
    const unmarked = found.map((text) => text.replaceAll(/\\u200b[^\\u00ad\\u200b]*(\\u00ad|$)/g, " "));
    return unmarked.filter((text) => /[a-z]/i.test(text));
}"""
# What the server tells with the page: words of the spec's schema, and titles of a report's pictures.
TOLD = """async () => {
    const [{ SPEC, PASS }, { PICTURES }] = await Promise.all(
        ["new/fields.js", "job/report_pictures.js"].map((path) => import(`/page/${path}`)),
    );
    const rows = [...SPEC, ...PASS].map(({ label, hint, table, names, choices, kind, usual }) => [
        label, hint, table, names, choices.map(([, words, more]) => [words, more]),
        ["number", "whole", "numbers"].includes(kind) && typeof usual === "string" && usual,
    ]);
    return [...rows, ...PICTURES.map(({ title, note }) => [title, note])].flat(Infinity);
}"""
# What is the same in every language.
SAME = re.compile(
    r"causticmill|grbl|CSV|G-code|XXXX-XXXX-XXXX|G0 X0 Y0|\b[XYZR]\d*\b|\b[XY]0\b|[←→] [XY]|[↑↓] [XYZ]|\bG0[58](?:\.1)?"
    r"|\bG5[4-9]\b"
    r"|(?<![a-z])(?:mm/s²|rad/mm|cm³/min|W|mm|µm|min|rpm|dB|kB|MB|nm|ms|B|h|s)(?![a-z])"  # units
    r"|[\w.-]*\.(?:nc|png|toml|zip|html|obj|stl|step|json|bin|path|npz|pdf)\b|\bpass-\d\b"  # files
    r"|\b(?:Ada|Grace|anonymous|astronaut|shop|simulated|portrait|logo|picture-\d+|finish|PMMA|abc|two)\b"
    r"|\bconnected\b"  # in the log, by an agent that has no code for it
    r"|\b\d{1,2}\. \w{3}\w*|\b\w{3}\w*\.? \d{4}\b"  # dates, which the browser says in its own words
)


def keys_in(source: str) -> Iterator[str]:
    """Every text that is looked up: of t("...") and, its values numbered, of t`...`."""
    for start in STARTS.finditer(source):
        yield json.loads(start[1]) if start[1] else _template(source, start.end())[0]


def _template(source: str, at: int) -> tuple[str, int]:
    """A template from behind its first backtick: its text, and where it ends."""
    text, number = "", 0
    while source[at] != "`":
        if source.startswith("${", at):
            at = _value_end(source, at + 2)
            text, number = f"{text}{{{number}}}", number + 1
        else:
            at += source[at] == "\\"
            text, at = text + source[at], at + 1
    return text, at + 1


def _value_end(source: str, at: int) -> int:
    depth = 1
    while depth:
        if source[at] == "`":
            at = _template(source, at + 1)[1]
        elif quoted := re.compile(r""""(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'""").match(source, at):
            at = quoted.end()
        else:
            depth += {"{": 1, "}": -1}.get(source[at], 0)
            at += 1
    return at


def seen_everywhere() -> set[str]:
    """What every answer about mills says of them, and so every screen: the page has it with its own words."""
    kinds = {load_profile(name, ()).description for name in profile_names(())}
    return kinds | {*_ON_HOLD.values(), *_ON_LOST_LINK.values()} | {"locked: home ($H) or unlock ($X)"}


def keys_of_the_page(modules: Page) -> set[str]:
    sources = [path.read_text("utf-8") for path in FOLDER.rglob("*.js") if path.stem != "language"]
    frame = (FOLDER / "index.html").read_text("utf-8").partition("<noscript>")[0]
    own = {text or label for text, label in re.findall(r'data-t>([^<]+)|aria-label="([^"]+)', frame)}
    told = {text for text in modules.evaluate(TOLD) if text and re.search("[A-Za-z]", SAME.sub("", text))}
    return own | told | seen_everywhere() | {key for source in sources for key in keys_in(source)}


@cache
def keys_of_the_server() -> set[str]:
    """Every template of a phrase that says more than its values, as sources and the library of processes have it."""
    found = {one.template for one in built_in_sentences().values()}
    for package in ("optics", "cam", "machines", "service"):
        for path in (TOP / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Phrase":
                    template = getattr(node.args[0], "value", None)
                    assert isinstance(template, str), (path, node.lineno)
                    found.add(key_of(template))
    found |= set(keys_of_the_sheet())
    return {key for key in found if re.search("[A-Za-z]", PLACEHOLDER.sub("", key))}


def keys_of_the_sheet() -> Iterator[str]:
    """Every template that the setup sheet's HTML looks up: of t("...")."""
    for path in sorted(TEMPLATES.glob("*.html")):
        for call in Environment().parse(path.read_text("utf-8")).find_all(nodes.Call):
            if isinstance(call.node, nodes.Name) and call.node.name == "t":
                [template] = call.args
                assert isinstance(template, nodes.Const), (path, call.lineno)
                yield template.value


def key_of(template: str) -> str:
    named = [name for _, name, _, _ in Formatter().parse(template) if name]
    return Phrase(template, **dict.fromkeys(named, 0)).template


def strings_in(told: Any) -> Iterator[str]:
    """What a server says freely; its codes are told in words of the page."""
    if isinstance(told, str) and not re.fullmatch(r"[a-z_-]*|.{1,3}", told):
        yield told
    elif isinstance(told, dict):
        for value in told.values():
            yield from strings_in(value)
    elif isinstance(told, list | tuple):
        for value in told:
            yield from strings_in(value)


@cache
def texts_said() -> list[str]:
    states = machine_states
    told = [
        *(states.MACHINE, states.RUN, states.PLAN, list(states.STATES.values()), ESTIMATE_EXAMPLE, FAULT),
        *(canned_job.job(), canned_job.plan(), LONG_NAME, LONG_NAME.removesuffix(".png")),
        *(f"{LONG_NAME}: line 3: no value", "this is not a picture that can be read", "grbl-3018: engraver"),
        [f"{state}-{LONG_NAME}" for state in states.STATES],
    ]
    return sorted(strings_in(told), key=len, reverse=True)


def without_what_is_said(text: str) -> str:
    """What is left of a text that no table has."""
    for said in texts_said():
        text = re.sub(re.escape(said).replace(r"\-", "[-−]"), " ", text, flags=re.IGNORECASE)
    return " ".join(SAME.sub(" ", text).split())


def test_keys_are_read_out_of_sources() -> None:
    source = 't("Save") at("no") t`${left} of ${a ? t("all") : `${b}}`} lines` x.t("no") t("a \\"b\\"")'
    assert list(keys_in(source)) == ["Save", "{0} of {1} lines", "all", 'a "b"']


@pytest.mark.parametrize("language", TABLES)
def test_no_sentence_is_missing_and_none_left_over(modules: Page, language: str) -> None:
    page, server = keys_of_the_page(modules), keys_of_the_server()
    assert len(page) > 1000 and len(server) > 1000
    for keys, table in ((page, OF_PAGE[language]), (server - page, OF_SERVER[language])):
        assert sorted(keys - set(table)) == []
        assert sorted(set(table) - keys) == []


@pytest.mark.parametrize("language", TABLES)
def test_every_value_has_its_place_in_every_language(language: str) -> None:
    wrong = [key for key, words in TABLES[language].items() if _places(words) != _places(key) or not words.strip()]
    assert wrong == []


def _places(text: str) -> list[str]:
    return sorted(PLACEHOLDER.findall(text))


@pytest.mark.parametrize("name", mostly_thorough(SHOWN, quick=QUICK))
def test_nothing_is_written_past_the_tables(open_unpainted: Opened, name: str) -> None:
    page = SHOWN[name](partial(open_unpainted, script=MARKED))
    texts = page.evaluate(UNMARKED)
    left = {rest for text in texts if re.search("[A-Za-z]", rest := without_what_is_said(text))}
    assert not left, "\n".join(sorted(left))


def of_languages(*names: str) -> str:
    """A browser that asks for these."""
    return f"Object.defineProperty(navigator, 'languages', {{ get: () => {list(names)} }});"


@pytest.mark.parametrize(("language", "jobs", "stop"), [("de", "Aufträge", "STOPP"), ("ja", "ジョブ", "停止")])
def test_a_language_is_the_browsers_or_the_one_chosen(opened: Opened, language: str, jobs: str, stop: str) -> None:
    page = opened(script=of_languages("fr", f"{language}-XX", "en"))
    expect(page.get_by_role("link", name=jobs, exact=True)).to_be_visible()
    assert page.evaluate("document.documentElement.lang") == language
    page.evaluate("location.hash = '#/machines/shop'")
    expect(page.locator(".stops .stop span")).to_have_text(stop)
    page.evaluate("location.hash = '#/'")
    page.locator("footer select").select_option("en")
    expect(page.get_by_role("link", name="Jobs", exact=True)).to_be_visible()
    assert page.evaluate("document.documentElement.lang") == "en"
    page.evaluate("localStorage.clear()")


LONG = ("jobs", "job", "job-planned", "machines", *(name for name in SHOWN if name.startswith("watched")))


@pytest.mark.parametrize("name", mostly_thorough(LONG, quick=("machines", "watched-interrupted", "watched-held")))
def test_nothing_is_cut_in_german_whose_words_are_the_longest(open_unpainted: Opened, name: str) -> None:
    page = SHOWN[name](partial(open_unpainted, script=of_languages("de")))
    for size in ("wide", "phone", "narrow"):
        width, height, *_ = SIZES[size]
        page.set_viewport_size({"width": width, "height": height})
        assert layout_faults(page) == [], size


def test_what_is_ticked_before_a_start_is_in_the_language_of_the_page(opened: Opened) -> None:
    page = of_a_machine_watched("parked")(partial(opened, script=of_languages("de")))
    ticks = page.locator(".checklist .tick small")
    expect(ticks.nth(0)).to_contain_text("Kugelfräser, R 0.5 (Ø 1 mm); Werkzeug wechseln von R 3 (Ø 6 mm) zu R 0.5")
    expect(ticks.nth(1)).to_contain_text("vordere linke Ecke der Linse, 8 mm von")


def test_what_a_server_says_is_told_in_the_language_of_the_page(opened: Opened) -> None:
    """The page's own way and that of a document on paper come to the same words."""
    of = Phrase("Left out: {0}, {1}.", **{"0": "ball", "1": "why"})
    answer = {
        "a": [
            Phrase("Save"),
            Phrase("the program moves nothing"),
            "as it is",
            {"b": Phrase("{file}: {what}", file="x.nc", what=of)},
        ],
        "c": None,
        "d": 7,
    }
    sent = {**answer, "phrases": phrases_in(answer)}
    page = opened(script=of_languages("de"))
    script = "async (sent) => (await import('/page/lib/language.js')).readAnswer(sent)"
    told = page.evaluate(script, json.dumps(sent, separators=(",", ":")))
    assert told == {**say(restore(answer, phrases_in(answer)), TABLES["de"]), "phrases": sent["phrases"]}
    of_page, of_server, as_it_is, made = told["a"]
    assert (of_page, of_server) == (OF_PAGE["de"]["Save"], OF_SERVER["de"]["the program moves nothing"])
    assert as_it_is == "as it is" and made["b"] == f"x.nc: {TABLES['de']['Left out: {0}, {1}.'].format('ball', 'why')}"


def test_the_setup_sheet_is_the_one_in_the_language_of_the_page(opened: Opened) -> None:
    script = "async (names) => (await import('/page/job/save.js')).sheetOf(new Map(names.map((name) => [name, name])))"
    every = ["report.html", "report-de.html", "report-ja.html"]
    page = opened(script=of_languages("de"))
    assert page.evaluate(script, every) == "report-de.html"
    assert page.evaluate(script, ["report.html", "report-ja.html"]) == "report.html"  # of a job made earlier
    assert opened().evaluate(script, every) == "report.html"


def test_english_loads_no_table(page: Page) -> None:
    expect(page.get_by_role("link", name="Jobs", exact=True)).to_be_visible()
    assert "/languages/" not in page.evaluate("performance.getEntriesByType('resource').map((one) => one.name).join()")


def test_without_its_table_the_page_is_english(opened: Opened) -> None:
    nowhere = "const load = fetch; window.fetch = (path, ...how) => load(/languages/.test(path) ? '/-' : path, ...how);"
    page = opened(script=of_languages("de") + nowhere, errors=("status of 404",))
    expect(page.get_by_role("link", name="Jobs", exact=True)).to_be_visible()
    assert page.evaluate("document.documentElement.lang") == "en"
