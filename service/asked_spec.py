"""A resolved job spec written as shortly as it can be: what a person has to ask for to get it again."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any

from service.errors import SpecError
from service.spec_files import resolve_spec

Json = dict[str, Any]
Place = tuple[str | int, ...]

# In place of a measured light while the rest is tried: it has 16,384 values, is never a default, and each try reads it.
_SOME_PROFILE = [[1.0, 1.0], [1.0, 1.0]]


def asked_spec(resolved: Mapping[str, Any]) -> Json:
    """The smallest part of `resolved` (JSON-able) that resolves to the same; all of it where it does not resolve."""
    asked = _without_nulls(resolved)
    light = asked.get("optics", {}).get("light", {})
    profile = light.get("profile")
    if profile is not None:
        light["profile"] = _SOME_PROFILE
    try:
        wanted = _resolved(asked)
        for place in _places(asked):
            shorter = _without(asked, place)
            if _resolves_to(shorter, wanted):
                asked = shorter
    except SpecError:
        pass
    if profile is not None:
        asked["optics"]["light"]["profile"] = profile
    return asked


def _places(spec: Mapping[str, Any]) -> Iterator[Place]:
    """Tables before what they hold."""
    for key in spec:
        yield (key,)
        held = enumerate(spec[key]) if isinstance(spec[key], list) else [(None, spec[key])]
        for number, table in held:
            if isinstance(table, Mapping):
                start = (key,) if number is None else (key, number)
                yield from ((*start, *rest) for rest in _places(table))


def _without(spec: Json, place: Place) -> Json:
    """A copy that lacks what lies at a place; it may be gone already."""
    found: Any = (copied := copy.deepcopy(spec))
    for step in place[:-1]:
        if isinstance(found, Mapping) and step not in found:
            return copied
        found = found[step]
    found.pop(place[-1], None)
    return copied


def _resolves_to(spec: Json, wanted: Json) -> bool:
    try:
        return _resolved(spec) == wanted
    except SpecError:
        return False


def _resolved(spec: Json) -> Json:
    return resolve_spec(base=spec).model_dump(mode="json")


def _without_nulls(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nulls(held) for key, held in value.items() if held is not None}
    return [_without_nulls(held) for held in value] if isinstance(value, list) else value
