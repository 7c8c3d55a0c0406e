"""Translatable sentences for people: each keeps its template and values.

Every package may use it; it uses none. English stands in the sources, and is the key of a table of another language
(service/page/languages), as in gettext. `make lint` lists missing translations (docs/languages.py).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from string import Formatter
from typing import Any, Self

_FORMATTER = Formatter()
_PLACE = re.compile(r"\{(\w+)\}")


class Phrase(str):
    """An English sentence: a str that also carries its template and values, for translation and for programs.

    template : with {name} where a value stands, without formats
    values   : the text in each place, formatted, or another phrase
    """

    __slots__ = ("template", "values")
    template: str
    values: Mapping[str, str]

    def __new__(cls, template: str, /, **values: object) -> Self:
        """Make a sentence from a template of `str.format`, whose fields are names of the values."""
        said, text, key = {}, "", ""
        for before, name, how, _ in _FORMATTER.parse(template):
            text, key = text + before, key + before
            if name is not None:
                value = values[name]
                said[name] = value if isinstance(value, Phrase) else format(value, how or "")
                text, key = text + said[name], f"{key}{{{name}}}"
        made = super().__new__(cls, text)
        made.template, made.values = key, said
        return made

    @classmethod
    def of_text(cls, text: str) -> Self:
        """Make a sentence of a whole text without places for values, as it stands in a data file."""
        return cls(text.replace("{", "{{").replace("}", "}}"))

    def __str__(self) -> str:
        """Return itself, so that `str(error)` of an error that was made from a phrase is the phrase."""
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return _remake, (str.__str__(self), self.template, dict(self.values))

    def map(self, change: Callable[[str], str]) -> Phrase:
        """Return the phrase with every text changed character by character, except the names of its values."""
        values = {
            name: one.map(change) if isinstance(one, Phrase) else change(one) for name, one in self.values.items()
        }
        return _remake(change(str.__str__(self)), change(self.template), values)

    def plain(self) -> dict[str, Any]:
        """Return template and values for JSON."""
        values = {name: one.plain() if isinstance(one, Phrase) else one for name, one in self.values.items()}
        return {"template": self.template, "values": values}


def _remake(text: str, template: str, values: dict[str, str]) -> Phrase:
    made = str.__new__(Phrase, text)
    made.template, made.values = template, values
    return made


NO_WORDS = Phrase("")


def join(separator: str, parts: Iterable[str]) -> Phrase:
    """Return phrases one after the other, as `separator.join` does."""
    named = {f"part{number}": part for number, part in enumerate(parts)}
    between = separator.replace("{", "{{").replace("}", "}}")
    return Phrase(between.join(f"{{{name}}}" for name in named), **named)


def phrases_in(document: Any) -> dict[str, dict[str, Any]]:
    """Return the template and values of each phrase in a document that becomes JSON, by the phrase's text."""
    return {text: text.plain() for text in _find(document)}


def restore(document: Any, phrases: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a document read from JSON with its phrases in place of their texts, without its table of phrases."""
    if isinstance(document, str):
        return _make(phrases[document], document) if document in phrases else document
    if isinstance(document, Mapping):
        return {key: restore(value, phrases) for key, value in document.items() if value is not phrases}
    if isinstance(document, list | tuple):
        return [restore(value, phrases) for value in document]
    return document


def _make(plain: Mapping[str, Any], text: str = "") -> Phrase:
    values = {name: one if isinstance(one, str) else _make(one) for name, one in plain["values"].items()}
    return _remake(text or _fill(plain["template"], values), plain["template"], values)


def _fill(template: str, values: Mapping[str, str]) -> str:
    """Return a template without formats with its values in their places."""
    return _PLACE.sub(lambda place: values.get(place[1], place[0]), template)


def _find(document: Any) -> Iterator[Phrase]:
    if isinstance(document, Phrase):
        yield document
    elif isinstance(document, Mapping):
        for value in document.values():
            yield from _find(value)
    elif isinstance(document, list | tuple):
        for value in document:
            yield from _find(value)


def say(document: Any, table: Mapping[str, str]) -> Any:
    """Translate a document that still contains its phrases by a language's table. Other texts, and phrases that are not
    in the table, stay unchanged.
    """
    if isinstance(document, Phrase):
        return _fill(table.get(document.template, document.template), say(document.values, table))
    if isinstance(document, Mapping):
        return {key: say(value, table) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [say(value, table) for value in document]
    return document
