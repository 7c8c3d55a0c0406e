"""Builds a job spec from defaults, an earlier job or a TOML/JSON file, a preset, and --set overrides; and reduces one
to the shortest that resolves to the same job.
"""

from __future__ import annotations

import copy
import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from machines.profile import load_profile
from machines.profile_values import UnreadableFileError, read_data
from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.files import SPEC
from service.job.spec.errors import as_spec_error, list_known_keys, unknown_key
from service.job.spec.finish import BEST
from service.job.spec.model import PRESETS, JobSpec
from service.job.spec.resolve import (
    Figures,
    LoadProfile,
    ResolvedJob,
    complete_job,
    look_up,
    preset_rows,
    without_derived,
)

RECOMMENDED_MARGIN_MM = 20.0  # a ring that can be clamped beside the 12 mm that a 6 mm ball clears
# What commands and page begin with: the best plan for the mill, finished by hand.
DEFAULT_JOB = {
    "preset": "recommended",
    "finish": {"process": BEST},
    "stock": {"margin_mm": RECOMMENDED_MARGIN_MM},
}
_INDEX = re.compile(r"\d{1,4}")
Json = dict[str, Any]
Place = tuple[str | int, ...]
# Stands in for a measured light while the other values are tried: it has 16,384 values, which each try would read, and
# is never a default.
_SOME_PROFILE = [[1.0, 1.0], [1.0, 1.0]]


def resolve_job(
    *,
    file: Path | None = None,
    preset: str | None = None,
    overrides: Sequence[str] = (),
    base: Mapping[str, Any] | None = None,
    light_picture: Path | None = None,
    load: LoadProfile = load_profile,
) -> ResolvedJob:
    """Resolve the complete job: defaults, then base, then file, then preset, then overrides ('key.key=value').

    light_picture is a measured picture of the light, which becomes optics.light.profile; load reads a mill's profile.
    Naming a preset replaces the passes of the base; it is an error beside the passes of a file, which it would drop.
    Raises SpecError, one line for each thing that cannot be used.
    """
    data = spec_data(file=file, preset=preset, overrides=overrides, base=base, light_picture=light_picture)
    return complete_job(look_up(validate_spec(data), load))


def default_layer(*, file: Path | None, preset: str | None, overrides: Sequence[str]) -> dict[str, Any]:
    """Return the lowest layer of a command line's spec: DEFAULT_JOB if the command names neither passes nor a file,
    without its finish if the command names one; otherwise nothing.

    Measured for the mills in `machines/profiles`, `camera`, 100 mm: docs/passes.md.
    """
    keys = {text.partition("=")[0].strip() for text in overrides}
    sections = {key.partition(".")[0] for key in keys}
    if file is not None or preset is not None or sections & {"preset", "passes"}:
        return {}
    return {key: value for key, value in copy.deepcopy(DEFAULT_JOB).items() if key == "preset" or key not in sections}


def override_machine(name: str | None) -> list[str]:
    """Return the override that --machine NAME stands for."""
    return [] if name is None else [f"machine.profile={json.dumps(name)}"]


def resolve_spec(**given: Any) -> JobSpec:
    """Return the spec of `resolve_job` with the same arguments."""
    return resolve_job(**given).spec


def spec_data(
    *,
    file: Path | None = None,
    preset: str | None = None,
    overrides: Sequence[str] = (),
    base: Mapping[str, Any] | None = None,
    light_picture: Path | None = None,
) -> dict[str, Any]:
    """Return the plain data that resolve_job validates, merged from all sources."""
    data = _merge(base or {}, read_spec_file(file) if file else {})
    if preset is not None:
        if file and "passes" in read_spec_file(file):
            words = Phrase(
                "{file} lists its passes, and preset '{preset}' has its own; leave out [[passes]] or the preset",
                file=file.name,
                preset=preset,
            )
            raise SpecError([("passes", words)])
        data = {**data, "preset": preset}
        data.pop("passes", None)
    chosen = [text for text in overrides if text.partition("=")[0].strip() == "preset"]
    for text in chosen:
        _override(data, text)
    _require_preset(data.get("preset", "paper"))
    data.setdefault("passes", preset_rows(data.get("preset", "paper")))
    if data.get("preset") == "recommended":
        _leave_room(data)
    for text in overrides:
        if text not in chosen:
            _override(data, text)
    if light_picture is not None:
        _set_profile(data, light_picture)
    return data


def validate_spec(data: Mapping[str, Any]) -> JobSpec:
    """Validate plain data as the model; SpecError in place of pydantic's error."""
    try:
        return JobSpec.model_validate(data)
    except ValidationError as error:
        raise as_spec_error(error) from None


def read_spec_file(path: Path, *, given_as: str = "--spec") -> dict[str, Any]:
    """Read plain data of a .toml or .json file; SpecError names the fault and its line."""
    try:
        return read_data(path)
    except UnreadableFileError as error:
        raise SpecError([(given_as, Phrase("{path}: {cause}", path=path, cause=error.words))]) from None


def load_stored_spec(folder: Path) -> JobSpec:
    """Load the spec of an earlier job; SpecError if there is none."""
    path = folder / SPEC
    if not path.is_file():
        words = Phrase(
            "{folder} holds no {file}; allowed: the folder of an earlier design or make", folder=folder, file=SPEC
        )
        raise SpecError([("DIR", words)])
    data = read_spec_file(path, given_as="DIR")
    try:
        return validate_spec(data)
    except SpecError as error:
        raise SpecError([(f"{path}: {key}", sentence) for key, sentence in error.problems]) from None


def load_stored_job(folder: Path) -> ResolvedJob:
    """Return the earlier job in a folder, with the present figures of this computer's files. SpecError."""
    return look_up(load_stored_spec(folder))


def restore_job(spec: Mapping[str, Any], figures: str | None) -> ResolvedJob:
    """Restore a stored job from plain data and text. figures: None if it was submitted before figures were stored."""
    found = validate_spec(spec)
    return look_up(found) if figures is None else ResolvedJob(spec=found, figures=Figures.from_text(figures))


def resolve_for_lens(
    folder: Path, *, file: Path | None = None, preset: str | None = None, overrides: Sequence[str] = ()
) -> ResolvedJob:
    """Resolve the complete job of new programs for a job folder's lens: the folder's spec, then as resolve_job."""
    stored = load_stored_job(folder)
    wanted = resolve_job(base=without_derived(stored), file=file, preset=preset, overrides=overrides)
    require_same_lens(stored.spec, wanted.spec)
    return wanted


def require_same_lens(stored: JobSpec, wanted: JobSpec) -> None:
    """Raise SpecError if `wanted` asks for another lens than the existing one."""
    pairs = [("image", stored.image, wanted.image), ("optics", stored.optics, wanted.optics)]
    problems = [
        (
            f"{name}.{key}",
            Phrase(
                "this lens was designed with {value}; allowed: the same, or a new `causticmill design`", value=str(old)
            ),
        )
        for name, before, after in pairs
        for key, old in before.model_dump().items()
        if after.model_dump()[key] != old
    ]
    stock = ["skim_mm", "thickness_mm"] if stored.optics.light_crosses_block else ["skim_mm"]
    for key in stock:  # oblique light arrives elsewhere through a thicker block
        if (old := getattr(stored.stock, key)) != getattr(wanted.stock, key):
            words = Phrase("this lens was designed with {value}; allowed: the same", value=old)
            problems.append((f"stock.{key}", words))
    if problems:
        raise SpecError(problems)


def parse_override(text: str) -> tuple[list[str], Any]:
    """Parse 'optics.width_mm=40' -> (['optics', 'width_mm'], 40). Values as in TOML, a bare word is a string."""
    key, equals, written = text.partition("=")
    steps = [step.strip() for step in key.split(".")]
    if not equals or not all(steps) or not written.strip():
        words = Phrase("'{text}' must have the form key=value, for example optics.width_mm=40", text=text)
        raise SpecError([("--set", words)])
    try:
        parsed = tomllib.loads(f"value = {written.strip()}")
    except (ValueError, RecursionError):
        parsed = {"value": written.strip()}
    value = parsed["value"] if set(parsed) == {"value"} else written.strip()
    return steps, value


def _require_preset(preset: object) -> None:
    if preset not in PRESETS:
        words = Phrase(
            "{value} is not allowed; allowed: {allowed}",
            value=f"'{preset}'",
            allowed=", ".join(f"'{name}'" for name in PRESETS),
        )
        raise SpecError([("preset", words)])


def _leave_room(data: dict[str, Any]) -> None:
    """Set a margin that allows large balls, if the person gave no margin."""
    stock = data.get("stock", {})
    if isinstance(stock, Mapping):
        data["stock"] = {"margin_mm": RECOMMENDED_MARGIN_MM, **stock}


def _merge(lower: Mapping[str, Any], upper: Mapping[str, Any]) -> dict[str, Any]:
    """Merge upper into lower, table by table; lists are replaced whole. A new preset in upper drops lower's passes."""
    result = dict(lower)
    if upper.get("preset") not in (None, lower.get("preset")):
        result.pop("passes", None)
    for key, value in upper.items():
        below = result.get(key)
        result[key] = _merge(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return result


def _override(data: dict[str, Any], text: str) -> None:
    """Set one key in place; copy the tables and passes on the path to it, never share them."""
    steps, value = parse_override(text)
    here: Any = data
    for depth, step in enumerate(steps[:-1]):
        place = steps[: depth + 1]
        below = here[_index(here, place)] if isinstance(here, list) else here.get(step, {})
        if not isinstance(below, Mapping | list):
            words = Phrase("there is no such key; '{key}' is a single value", key=".".join(place))
            raise SpecError([(".".join(steps), words)])
        if isinstance(here, dict) and step not in here and step not in list_known_keys(_place(steps[:depth])):
            raise SpecError([(".".join(steps), unknown_key(step, list_known_keys(_place(steps[:depth]))))])
        copy = list(below) if isinstance(below, list) else dict(below)
        here[_index(here, place) if isinstance(here, list) else step] = copy
        here = copy
    here[_index(here, steps) if isinstance(here, list) else steps[-1]] = value


def _set_profile(data: dict[str, Any], picture: Path) -> None:
    """Set optics.light.profile to the picture's rows; its tones are read like those of the job's picture."""
    from service.job.picture.reading import light_rows  # imports arrays, which a caller that only plans does not need

    optics, image = data.get("optics", {}), data.get("image", {})
    light = optics.get("light", {}) if isinstance(optics, Mapping) else {}
    if not isinstance(optics, Mapping) or not isinstance(light, Mapping):
        return  # not a table; validation refuses it by its type
    tone = image.get("tone") if isinstance(image, Mapping) else None
    rows = light_rows(picture, tone="linear" if tone == "linear" else "srgb")
    data["optics"] = {**optics, "light": {**light, "profile": rows}}


def _index(rows: Sequence[Any], place: Sequence[str]) -> int:
    if not _INDEX.fullmatch(place[-1]) or int(place[-1]) >= len(rows):
        words = (
            Phrase("there is no such pass; allowed: 0 to {last}", last=len(rows) - 1)
            if rows
            else Phrase("there is no such pass; allowed: none, the list is empty")
        )
        raise SpecError([(".".join(place), words)])
    return int(place[-1])


def _place(steps: Sequence[str]) -> tuple[int | str, ...]:
    return tuple(int(step) if step.isdigit() else step for step in steps)


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
        for _ in range(2):  # a value may follow from one that was removed later, as a feed follows from a speed
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
