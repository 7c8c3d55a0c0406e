"""Compares the tables of other languages with the sentences in the sources:  python -m docs.languages [--strict]

A sentence without a row is shown in English. This lists it, and rows that no sentence uses any more; with --strict, as
in `make release`, either makes the exit code 1.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

from jinja2 import Environment, nodes

from machines.profile import _ON_HOLD, _ON_LOST_LINK, load_profile, profile_names
from phrases.phrase import Phrase
from service.job.report.pictures import PICTURES
from service.job.spec.finish_library import built_in_sentences
from service.job.spec.model import JobSpec
from service.page.files import FOLDER

TOP = Path(__file__).parents[1]
TEMPLATES = TOP / "service/job/report/templates"
PLACEHOLDER = re.compile(r"\{\w+\}")
_STARTS = re.compile(r"""(?<![\w.$])t(?:\(\s*("(?:[^"\\]|\\.)*")|`)""")
_QUOTED = re.compile(r""""(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'""")
# Text that is the same in every language.
SAME = re.compile(
    r"causticmill|grbl|CSV|G-code|XXXX-XXXX-XXXX|G0 X0 Y0|\b[XYZR]\d*\b|\b[XY]0\b|[←→] [XY]|[↑↓] [XYZ]|\bG0[58](?:\.1)?"
    r"|\bG5[4-9]\b"
    r"|(?<![a-z])(?:mm/s²|rad/mm|cm³/min|W|mm|µm|min|rpm|dB|kB|MB|nm|ms|B|h|s)(?![a-z])"  # units
    r"|[\w.-]*\.(?:nc|png|toml|zip|html|obj|stl|step|json|bin|path|npz|pdf)\b|\bpass-\d\b"  # files
    r"|\b(?:Ada|Grace|anonymous|astronaut|shop|simulated|portrait|logo|picture-\d+|finish|PMMA|abc|two)\b"
    r"|\bconnected\b"  # in the log, by an agent that has no code for it
    r"|\b\d{1,2}\. \w{3}\w*|\b\w{3}\w*\.? \d{4}\b"  # dates, which the browser formats itself
)


def read_tables(names: str) -> dict[str, dict[str, str]]:
    """Return the tables by language, of files that match."""
    return {path.stem: json.loads(path.read_text("utf-8")) for path in sorted(FOLDER.glob(f"languages/{names}"))}


OF_PAGE, OF_SERVER = read_tables("*.json"), read_tables("server/*.json")
TABLES = {language: OF_PAGE[language] | OF_SERVER[language] for language in OF_PAGE}


def keys_in(source: str) -> Iterator[str]:
    """Yield every text that a module of the page looks up: of t("...") and, its values numbered, of t`...`."""
    for start in _STARTS.finditer(source):
        yield json.loads(start[1]) if start[1] else _template(source, start.end())[0]


def _template(source: str, at: int) -> tuple[str, int]:
    """Return the text of a template that begins behind a backtick, and the place of its end."""
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
        elif quoted := _QUOTED.match(source, at):
            at = quoted.end()
        else:
            depth += {"{": 1, "}": -1}.get(source[at], 0)
            at += 1
    return at


@cache
def keys_of_the_page() -> frozenset[str]:
    """Return every text of the page itself: of its modules and its frame, of the form's fields, of pictures' titles,
    and of every answer about mills, which every screen shows.
    """
    sources = [path.read_text("utf-8") for path in FOLDER.rglob("*.js") if path.stem != "language"]
    frame = (FOLDER / "index.html").read_text("utf-8").partition("<noscript>")[0]
    own = {text or label for text, label in re.findall(r'data-t>([^<]+)|aria-label="([^"]+)', frame)}
    kinds = {load_profile(name, ()).description for name in profile_names(())}
    mills = kinds | {*_ON_HOLD.values(), *_ON_LOST_LINK.values()} | {"locked: home ($H) or unlock ($X)"}
    return frozenset(own | mills | set(keys_of_data()) | {key for source in sources for key in keys_in(source)})


def keys_of_data() -> Iterator[str]:
    """Yield the words of the form's fields, as service/page/new/fields.js makes them of the spec's schema, and of the
    report's pictures."""
    schema = JobSpec.model_json_schema()
    passes = _resolve(schema["properties"]["passes"]["items"], schema)
    words = [*_words_of(schema, schema), *_words_of(passes, schema)]
    words += [text for picture in PICTURES for text in (picture.title, picture.note)]
    yield from (text for text in words if text and re.search("[A-Za-z]", SAME.sub("", text)))


def _words_of(table: dict[str, Any], schema: dict[str, Any]) -> Iterator[str | None]:
    for field in table["properties"].values():
        inner = _resolve(field, schema)
        if "properties" in inner and not any(one.get("type") == "null" for one in field.get("anyOf", ())):
            yield field.get("title")
            yield from _words_of(inner, schema)
            continue
        form, enum = field.get("form", {}), inner.get("enum", ())
        choices = form.get("choices") or field.get("oneOf", ())
        numbers = inner.get("items", {}).get("type") == "number" and inner.get("minItems") == inner.get("maxItems")
        if choices or enum or numbers or inner.get("type") in ("boolean", "integer", "number", "string"):
            yield from (field.get("title"), field.get("description"), form.get("usual"), *form.get("names", ()))
            yield from (words for choice in choices for words in (choice.get("title"), choice.get("description")))
            yield from {str(value) for value in enum} - {str(choice["const"]) for choice in choices}


def _resolve(field: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Resolve a reference; of "this or nothing", return this."""
    one = next((one for one in field.get("anyOf", ()) if one.get("type") != "null"), field)
    found: dict[str, Any] = schema["$defs"][one["$ref"].rpartition("/")[2]] if "$ref" in one else one
    return found


@cache
def keys_of_the_server() -> frozenset[str]:
    """Return every template of a phrase that contains more than its values, from sources and the library of
    processes.
    """
    found = {one.template for one in built_in_sentences().values()}
    for package in ("optics", "cam", "machines", "service"):
        for path in (TOP / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Phrase":
                    template = getattr(node.args[0], "value", None)
                    assert isinstance(template, str), (path, node.lineno)
                    found.add(key_of(template))
    found |= set(keys_of_the_sheet())
    return frozenset(key for key in found if re.search("[A-Za-z]", PLACEHOLDER.sub("", key)))


def keys_of_the_sheet() -> Iterator[str]:
    """Yield every template that the setup sheet's HTML looks up: of t("...")."""
    for path in sorted(TEMPLATES.glob("*.html")):
        for call in Environment().parse(path.read_text("utf-8")).find_all(nodes.Call):
            if isinstance(call.node, nodes.Name) and call.node.name == "t":
                [template] = call.args
                assert isinstance(template, nodes.Const), (path, call.lineno)
                yield template.value


def key_of(template: str) -> str:
    named = [name for _, name, _, _ in Formatter().parse(template) if name]
    return Phrase(template, **dict.fromkeys(named, 0)).template


def find_gaps() -> Iterator[str]:
    """Yield a line for every sentence without a row, and for every row without a sentence."""
    page, server = keys_of_the_page(), keys_of_the_server()
    for folder, keys, tables in (("", page, OF_PAGE), ("server/", server - page, OF_SERVER)):
        for language, table in tables.items():
            yield from _compare(f"service/page/languages/{folder}{language}.json", keys, table)


def _compare(file: str, keys: Iterable[str], table: Iterable[str]) -> Iterator[str]:
    keys, rows = set(keys), set(table)
    yield from (f"{file}: no row: {json.dumps(key, ensure_ascii=False)}" for key in sorted(keys - rows))
    yield from (f"{file}: left over: {json.dumps(key, ensure_ascii=False)}" for key in sorted(rows - keys))


def main(arguments: list[str]) -> int:
    gaps = list(find_gaps())
    print(*gaps, sep="\n", end="\n" if gaps else "")
    return int(bool(gaps) and "--strict" in arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
