"""pydantic's complaints about a job spec, turned into one line each: key, value, what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from service.errors import SpecError
from service.job.spec.model import JobSpec
from service.job.spec.section import unit_of

Place = tuple[int | str, ...]
_MODEL_RULES = {"value_error", "assertion_error"}
MOST_PROBLEMS = 50  # each costs a search for the key that was meant, and nobody reads more
_KEY_CHARS = 60


def as_spec_error(error: ValidationError) -> SpecError:
    """Return one (key, sentence) pair for each thing pydantic found, in the order of the spec, of the first 50."""
    details = error.errors(include_url=False)
    count, details = len(details), details[:MOST_PROBLEMS]
    inner = {detail["loc"][:depth] for detail in details for depth in range(1, len(detail["loc"]))}
    told = [detail for detail in details if detail["loc"] not in inner]  # a list of bad rows is "too short" as well
    problems = [(join_place(detail["loc"]), _sentence(detail)) for detail in told]
    limits = {join_place(one["loc"]): bound for one in told for bound in _bounds(one)}
    if count > MOST_PROBLEMS:
        problems.append(("spec", f"{count - MOST_PROBLEMS} more problems like these"))
    return SpecError(list(dict.fromkeys(problems)), limits)


def _bounds(detail: ErrorDetails) -> Iterator[float]:
    """Yield the bound that a number is beyond, where it is allowed itself."""
    yield from (bound for name, bound in detail.get("ctx", {}).items() if name in ("le", "ge"))


def unknown_key(key: str, known: Sequence[str]) -> str:
    """Return what to say about a key nobody knows: the nearest known one, or all of them."""
    near = difflib.get_close_matches(key[:_KEY_CHARS], known, n=1, cutoff=0.6)
    if near:
        return f"there is no such key; did you mean '{near[0]}'?"
    return f"there is no such key; known here: {', '.join(known)}"


def join_place(place: Place) -> str:
    """Join ('passes', 0, 'pitch_mm') into 'passes.0.pitch_mm'."""
    return ".".join(str(step)[:_KEY_CHARS] for step in place) or "spec"


def word_allowed(place: Place) -> str:
    """Return the allowed values of a key, in words: 'a number more than 0 and at most 2000 (mm)'."""
    schema = _schema_at(place)
    return _words(schema, str(place[-1]) if place else "") if schema else "see the documentation"


def known_keys(place: Place) -> list[str]:
    """Return keys of the table at a place of the spec."""
    return list((_schema_at(place) or {}).get("properties", {}))


def _sentence(detail: ErrorDetails) -> str:
    place, kind, value = detail["loc"], detail["type"], detail["input"]
    if kind == "extra_forbidden":
        return unknown_key(str(place[-1]), known_keys(place[:-1]))
    if kind == "missing":
        return f"is missing; allowed: {word_allowed(place)}"
    if kind in _MODEL_RULES:
        return detail["msg"].partition(", ")[2]
    if kind == "too_short" and isinstance(value, list | tuple) and not value:
        return f"is empty; allowed: {word_allowed(place)}"
    return f"{_shown(value)} is not allowed; allowed: {word_allowed(place)}"


def _shown(value: Any) -> str:
    """Return a value as the person wrote it, cut to a length that keeps the message on one line."""
    text = f"'{value}'" if isinstance(value, str) else repr(value)
    if isinstance(value, bool):
        text = "true" if value else "false"
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."


@cache
def _spec_schema() -> dict[str, Any]:
    return JobSpec.model_json_schema()


def _schema_at(place: Place) -> dict[str, Any] | None:
    """Return the JSON schema of one key; None where the place does not exist."""
    here: dict[str, Any] = _spec_schema()
    for step in place:
        here = _resolve_schema(here)
        found = here.get("items") if isinstance(step, int) else here.get("properties", {}).get(step)
        if not isinstance(found, dict):
            return None
        here = found
    return _resolve_schema(here)


def _resolve_schema(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Follow $ref and 'X or null' to the schema that says something."""
    if "$ref" in schema:
        return _resolve_schema(_spec_schema()["$defs"][schema["$ref"].rpartition("/")[2]])
    for choice in schema.get("anyOf", ()):
        if choice.get("type") != "null":
            return _resolve_schema(choice)
    return dict(schema)


def _words(schema: Mapping[str, Any], key: str) -> str:
    if "enum" in schema:
        return ", ".join(f"'{value}'" for value in schema["enum"])
    if "const" in schema:
        return f"'{schema['const']}'"
    match schema.get("type"):
        case "boolean":
            return "true or false"
        case "object":
            return f"a table with the keys {', '.join(schema.get('properties', {}))}"
        case "array":
            low, high = schema.get("minItems"), schema.get("maxItems")
            count = f"{low}" if low == high else f"{low} to {high}"
            return f"a list of {count} {'numbers' if 'number' in str(schema['items']) else 'tables'}"
        case "string":
            if "pattern" in schema:
                return f"lower-case letters, digits and hyphens, at most {schema['maxLength']}"
            return "a text"
    return f"a {'whole ' * (schema.get('type') == 'integer')}number{_range(schema)}{_unit(key)}"


def _range(schema: Mapping[str, Any]) -> str:
    if "minimum" in schema:
        return f" from {schema['minimum']:g} to {schema['maximum']:g}"
    if "exclusiveMinimum" in schema:
        return f" more than {schema['exclusiveMinimum']:g} and at most {schema['maximum']:g}"
    return ""


def _unit(key: str) -> str:
    unit = unit_of(key).replace("°", "degrees")
    return f" {unit}" if unit else ""
