"""Turns pydantic's complaints about a job spec into one line each: key, value, what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.spec.model import JobSpec
from service.job.spec.section import RuleError, unit_of

Place = tuple[int | str, ...]
MOST_PROBLEMS = 50  # each costs a search for the nearest key, and nobody reads more
_KEY_CHARS = 60
_NO_TABLE = ("model_type", "model_attributes_type", "dict_type")


def as_spec_error(error: ValidationError) -> SpecError:
    """Return one (key, sentence) pair for each of the first 50 errors that pydantic found, in the order of the spec."""
    details = error.errors(include_url=False)
    count, details = len(details), details[:MOST_PROBLEMS]
    inner = {detail["loc"][:depth] for detail in details for depth in range(1, len(detail["loc"]))}
    details = [detail for detail in details if detail["loc"] not in inner]  # a list of bad rows is "too short" as well
    problems = [(_key_at_fault(detail), _sentence(detail)) for detail in details]
    limits = {join_place(one["loc"]): bound for one in details for bound in _bounds(one)}
    if count > MOST_PROBLEMS:
        problems.append(("spec", Phrase("{count} more problems like these", count=count - MOST_PROBLEMS)))
    return SpecError(list(dict.fromkeys(problems)), limits)


def _key_at_fault(detail: ErrorDetails) -> str:
    """Return the key that a person should change: for a rule about a whole table, the key that the rule names."""
    error = detail.get("ctx", {}).get("error")
    at = error.at.split(".") if isinstance(error, RuleError) and error.at else ()
    return join_place((*detail["loc"], *at))


def _bounds(detail: ErrorDetails) -> Iterator[float]:
    """Yield the bound that a number exceeds, if the bound itself is allowed."""
    yield from (bound for name, bound in detail.get("ctx", {}).items() if name in ("le", "ge"))


def unknown_key(key: str, known: Sequence[str]) -> Phrase:
    """Return the sentence about an unknown key: the nearest known one, or all of them."""
    near = difflib.get_close_matches(key[:_KEY_CHARS], known, n=1, cutoff=0.6)
    if near:
        return Phrase("there is no such key; did you mean '{key}'?", key=near[0])
    return Phrase("there is no such key; known here: {keys}", keys=", ".join(known))


def join_place(place: Place) -> str:
    """Join ('passes', 0, 'pitch_mm') into 'passes.0.pitch_mm'."""
    return ".".join(str(step)[:_KEY_CHARS] for step in place) or "spec"


def describe_allowed(place: Place) -> Phrase:
    """Describe the allowed values of a key: 'a number from 0.5 to 2000 mm'."""
    schema, keys = _schema_at(place), [step for step in place if isinstance(step, str)]
    return _words(schema, keys[-1] if keys else "") if schema else Phrase("see the documentation")


def list_known_keys(place: Place) -> list[str]:
    """Return keys of the table at a place of the spec."""
    return list(known_entries(place))


def describe_table(place: Place) -> str:
    """Return the docstring of the table at a place."""
    return str((_schema_at(place) or {}).get("description", ""))


def known_entries(place: Place) -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each key of the table at a place of the spec."""
    return (_schema_at(place) or {}).get("properties", {})


def _sentence(detail: ErrorDetails) -> Phrase:
    place, kind, value = detail["loc"], detail["type"], detail["input"]
    if kind == "extra_forbidden":
        radius = str(place[-1]).replace("diameter", "radius")
        if radius != place[-1] and radius in list_known_keys(place[:-1]) and isinstance(value, int | float):
            return Phrase(
                "there is no such key, cutters are given by their radius; did you mean {key} = {value:g}?",
                key=radius,
                value=value / 2,
            )
        return unknown_key(str(place[-1]), list_known_keys(place[:-1]))
    if kind in _NO_TABLE and isinstance(value, str) and (main := _find_main_key(place)):
        key = join_place((*place, main))
        return Phrase("is a table; did you mean {key}={value}?", key=key, value=_show_value(value).strip("'"))
    if kind == "missing":
        return Phrase("is missing; allowed: {allowed}", allowed=describe_allowed(place))
    if isinstance(error := detail.get("ctx", {}).get("error"), RuleError):
        return error.words
    if kind == "too_short" and isinstance(value, list | tuple) and not value:
        return Phrase("is empty; allowed: {allowed}", allowed=describe_allowed(place))
    return Phrase(
        "{value} is not allowed; allowed: {allowed}", value=_show_value(value), allowed=describe_allowed(place)
    )


def _find_main_key(place: Place) -> str:
    """Return the key of a table that a single word probably means: its first one, if that takes words."""
    first, entry = next(iter(known_entries(place).items()), ("", {}))
    return first if inner_schema(entry).get("type") == "string" or "enum" in inner_schema(entry) else ""


def _show_value(value: Any) -> str:
    """Return a value as the person wrote it, cut to fit one line of the message."""
    text = f"'{value}'" if isinstance(value, str) else repr(value)
    if isinstance(value, bool):
        text = "true" if value else "false"
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."


@cache
def _spec_schema() -> dict[str, Any]:
    return JobSpec.model_json_schema()


def _schema_at(place: Place) -> dict[str, Any] | None:
    """Return the JSON schema of one key; None if the place does not exist."""
    here: dict[str, Any] = _spec_schema()
    for step in place:
        here = inner_schema(here)
        found = here.get("items") if isinstance(step, int) else here.get("properties", {}).get(step)
        if not isinstance(found, dict):
            return None
        here = found
    return inner_schema(here)


def inner_schema(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Follow $ref and 'X or null' to the schema of the value."""
    if "$ref" in schema:
        return inner_schema(_spec_schema()["$defs"][schema["$ref"].rpartition("/")[2]])
    for choice in schema.get("anyOf", ()):
        if choice.get("type") != "null":
            return inner_schema(choice)
    return dict(schema)


def _words(schema: Mapping[str, Any], key: str) -> Phrase:
    if "enum" in schema:
        return Phrase("{names}", names=", ".join(f"'{value}'" for value in schema["enum"]))
    if "const" in schema:
        return Phrase("'{name}'", name=schema["const"])
    match schema.get("type"):
        case "boolean":
            return Phrase("true or false")
        case "object":
            return Phrase("a table with the keys {keys}", keys=", ".join(schema.get("properties", {})))
        case "array":
            low, high = schema.get("minItems"), schema.get("maxItems")
            count = f"{low}" if low == high else Phrase("{least} to {most}", least=low, most=high)
            if "number" in str(schema["items"]):
                return Phrase("a list of {count} numbers", count=count)
            return Phrase("a list of {count} tables", count=count)
        case "string":
            if "pattern" in schema:
                return Phrase("lower-case letters, digits and hyphens, at most {most}", most=schema["maxLength"])
            return Phrase("a text")
    number = _number(schema)
    if unit := unit_of(key):
        return Phrase("{number} {unit}", number=number, unit=Phrase("degrees") if unit == "°" else unit)
    return number


def _number(schema: Mapping[str, Any]) -> Phrase:
    kind = Phrase("a whole number") if schema.get("type") == "integer" else Phrase("a number")
    if "minimum" in schema:
        least, most = schema["minimum"], schema["maximum"]
        return Phrase("{kind} from {least:g} to {most:g}", kind=kind, least=least, most=most)
    return kind
