"""The page in other languages: none of its sentences is written past the tables. What a table lacks is shown in English
and listed by `make lint`; a release is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from docs import languages
from docs.languages import (
    OF_PAGE,
    OF_SERVER,
    PLACEHOLDER,
    SAME,
    TABLES,
    find_gaps,
    keys_in,
    keys_of_the_page,
    keys_of_the_server,
)
from phrases.phrase import Phrase, phrases_in, restore, say
from tests.levels import mostly_thorough
from tests.page import canned_job, machine_states
from tests.page.browser import layout_faults, open_blank
from tests.page.canned_job import ESTIMATE_EXAMPLE
from tests.page.conftest import Opened
from tests.page.test_screens import FAULT, LONG_NAME, SCREENS, SIZES, Screen

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

# In place of the German table: all sentences in English, each between two letters that nobody sees and that playwright
# leaves out of what it compares; what stands in for a placeholder is outside of them.
MARKED = """
const keys = KEYS;
Object.defineProperty(navigator, "languages", { get: () => ["de-AT"] });
const load = window.fetch;
window.fetch = async (path, ...how) => {
    const answer = await load(path, ...how);
    if (!String(path).endsWith("/de.json")) return answer;
    const mark = (key) => `\\u200b${key.replaceAll(/\\{\\w+\\}/g, "\\u00ad$&\\u200b")}\\u00ad`;
    return Response.json(Object.fromEntries(keys.map((key) => [key, mark(key)])));
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


def test_words_that_the_server_tells_the_page_are_found(modules: Page) -> None:
    told = {text for text in modules.evaluate(TOLD) if text and re.search("[A-Za-z]", SAME.sub("", text))}
    assert len(told) > 100
    assert told - keys_of_the_page() == set()


def test_a_gap_is_listed_and_refuses_a_release_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sentence of the page, one of the server, and a row that no sentence has."""
    before = set(find_gaps())
    of_page = {**OF_PAGE["de"], "No such sentence.": "Kein Satz."}
    of_server = dict(OF_SERVER["de"])
    for table, key in ((of_page, "Save"), (of_server, "the program moves nothing")):
        del table[key]
    monkeypatch.setitem(languages.OF_PAGE, "de", of_page)
    monkeypatch.setitem(languages.OF_SERVER, "de", of_server)
    assert set(find_gaps()) - before == {
        'service/page/languages/de.json: no row: "Save"',
        'service/page/languages/de.json: left over: "No such sentence."',
        'service/page/languages/server/de.json: no row: "the program moves nothing"',
    }
    assert languages.main([]) == 0 and 'no row: "Save"' in capsys.readouterr().out
    assert languages.main(["--strict"]) == 1
    monkeypatch.setattr(languages, "find_gaps", lambda: iter(()))
    assert languages.main(["--strict"]) == 0


@pytest.mark.parametrize("language", TABLES)
def test_every_value_has_its_place_in_every_language(language: str) -> None:
    wrong = [key for key, words in TABLES[language].items() if _places(words) != _places(key) or not words.strip()]
    assert wrong == []


def _places(text: str) -> list[str]:
    return sorted(PLACEHOLDER.findall(text))


@pytest.mark.parametrize("name", mostly_thorough(SHOWN, quick=QUICK))
def test_nothing_is_written_past_the_tables(open_unpainted: Opened, name: str) -> None:
    keys = json.dumps(sorted(keys_of_the_page() | keys_of_the_server()))
    page = SHOWN[name](partial(open_unpainted, script=MARKED.replace("KEYS", keys)))
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
    page.locator("footer select").last.select_option("en")
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
        "d": Phrase("a sentence of tomorrow about {n} mills", n=7),
    }
    sent = {**answer, "phrases": phrases_in(answer)}
    page = opened(script=of_languages("de"))
    script = "async (sent) => (await import('/page/lib/language.js')).readAnswer(sent)"
    told = page.evaluate(script, json.dumps(sent, separators=(",", ":")))
    assert told == {**say(restore(answer, phrases_in(answer)), TABLES["de"]), "phrases": sent["phrases"]}
    of_page, of_server, as_it_is, made = told["a"]
    assert (of_page, of_server) == (OF_PAGE["de"]["Save"], OF_SERVER["de"]["the program moves nothing"])
    assert told["d"] == "a sentence of tomorrow about 7 mills"  # no table has it: English
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
