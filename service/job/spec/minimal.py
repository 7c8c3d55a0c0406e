"""Reduces a resolved job spec to the shortest one that resolves to the same job."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from machines.profile import load_profile
from service.errors import SpecError
from service.job.spec.loading import resolve_spec
from service.job.spec.resolved import LoadProfile

Json = dict[str, Any]
Place = tuple[str | int, ...]

# In place of a measured light while the rest is tried: it has 16,384 values, is never a default, and each try reads it.
_SOME_PROFILE = [[1.0, 1.0], [1.0, 1.0]]


def reduce_spec(resolved: Mapping[str, Any]) -> Json:
    """Return the smallest part of `resolved` (JSON-able) that gives the same job; all of it if it does not resolve."""
    asked = _without_nulls(resolved)
    light = asked.get("optics", {}).get("light", {})
    profile = light.get("profile")
    if profile is not None:
        light["profile"] = _SOME_PROFILE
    try:
        load = cache(load_profile)  # each try resolves the whole spec, and would read the machine's profile again
        wanted = _resolve(asked, load)
        for place in _places(asked):
            shorter = _remove(asked, place)
            if shorter is not None and _resolves_to(shorter, wanted, load):
                asked = shorter
    except SpecError:
        pass
    if profile is not None:
        asked["optics"]["light"]["profile"] = profile
    return asked


def _places(spec: Mapping[str, Any]) -> Iterator[Place]:
    """Yield the places of all values, tables before their contents."""
    for key in spec:
        yield (key,)
        held = enumerate(spec[key]) if isinstance(spec[key], list) else [(None, spec[key])]
        for number, table in held:
            if isinstance(table, Mapping):
                start = (key,) if number is None else (key, number)
                yield from ((*start, *rest) for rest in _places(table))


def _remove(spec: Json, place: Place) -> Json | None:
    """Return a copy without the value at a place; None if its table is gone already."""
    found: Any = spec
    for step in place:
        if isinstance(found, Mapping) and step not in found:
            return None
        found = found[step]
    found = copied = copy.deepcopy(spec)
    for step in place[:-1]:
        found = found[step]
    del found[place[-1]]
    return copied


def _resolves_to(spec: Json, wanted: Json, load: LoadProfile) -> bool:
    try:
        return _resolve(spec, load) == wanted
    except SpecError:
        return False


def _resolve(spec: Json, load: LoadProfile) -> Json:
    return resolve_spec(base=spec, load=load).model_dump(mode="json")


def _without_nulls(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nulls(held) for key, held in value.items() if held is not None}
    return [_without_nulls(held) for held in value] if isinstance(value, list) else value
