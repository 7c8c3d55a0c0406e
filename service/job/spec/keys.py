"""Every key of the job spec with its allowed values, its default and its meaning, from the pydantic model itself."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from service.job.spec.errors import Place, describe_allowed, describe_table, inner_schema, join_place, known_entries


class KeyRow(NamedTuple):
    """One key. A number in a list of tables is written N: passes.N.pitch_mm."""

    key: str
    allowed: str
    default: str
    meaning: str

    def has(self, word: str) -> bool:
        return any(word.casefold() in text.casefold() for text in self)


def list_keys(word: str = "") -> list[KeyRow]:
    """Return the keys in the order of the spec; with a word, only those in which it occurs."""
    return [row for row in _list_rows(()) if row.has(word)]


def _list_rows(place: Place) -> Iterator[KeyRow]:
    for name, entry in known_entries(place).items():
        here = (*place, name)
        inner = inner_schema(entry)
        if inner.get("properties"):
            yield from _list_rows(here)
        elif inner_schema(inner.get("items", {})).get("properties"):
            yield from _list_rows((*here, 0))
        else:
            key = join_place(tuple("N" if isinstance(step, int) else step for step in here))
            yield KeyRow(key, str(describe_allowed(here)), _default_words(entry), _describe_meaning(name, entry, place))


def _default_words(entry: Mapping[str, Any]) -> str:
    default = entry.get("default")
    if default is None:
        usual = (entry.get("form") or {}).get("usual")
        return str(usual or ("must be given" if "default" not in entry else "left open"))
    if isinstance(default, bool):
        return str(default).lower()
    return f"{default:g}" if isinstance(default, float) else str(default)


def _describe_meaning(name: str, entry: Mapping[str, Any], place: Place) -> str:
    """Return title and hint; for a key without a title of its own its line in the docstring of its table, else its
    name.
    """
    if entry.get("form"):
        return ". ".join(str(entry[part]).rstrip(".") for part in ("title", "description") if entry.get(part))
    about = str(describe_table(place))
    found = re.search(rf"^ *{name} *: (.+?)(?=\n *\n|\n *\w+ +: |\Z)", about, re.MULTILINE | re.DOTALL)
    words = " ".join(found[1].split()) if found else name.removesuffix("_mm").replace("_", " ")
    return words[:1].upper() + words[1:]


def make_page() -> str:
    """Return the page of the documents that lists all keys."""
    lines = ["# Every key of a job", "", _INTRODUCTION, ""]
    section = ""
    for row in list_keys():
        if (name := row.key.partition(".")[0]) != section:
            section = name
            lines += [*([""] if lines[-1] else []), f"## {section}", "| key | allowed | default | meaning |"]
            lines.append("|---|---|---|---|")
        lines.append("| " + " | ".join(text.replace("|", "\\|") for text in (f"`{row.key}`", *row[1:])) + " |")
    return "\n".join(lines) + "\n"


_INTRODUCTION = (
    "Set one with `--set KEY=VALUE`, or in a spec (TOML or JSON) for `--spec`. `causticmill keys WORD` shows those in\n"
    "which a word occurs. N is the number of a pass, a clamp or another row, from 0."
)
