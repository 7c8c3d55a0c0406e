"""Every number of a spec has a range that makes sense in a shop: what lies beyond is refused by name, and at its ends
an estimate answers or refuses in words, but never breaks.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from service.errors import ServiceError, SpecError
from service.job.picture import OWN_PICTURE
from service.job.planning.estimate import estimate
from service.job.spec.loading import resolve_job
from service.job.spec.model import JobSpec

SCHEMA = JobSpec.model_json_schema()
LEAST, MOST = 1e-9, 1e9
BASE: dict[str, Any] = {
    "preset": "draft",
    "image": {"pixels": 24},
    "optics": {"width_mm": 20.0, "height_mm": 20.0, "throw_mm": 60.0, "light": {"kind": "collimated"}},
    "stock": {},
    "machine": {},
    "finish": {},
    "passes": [
        {"radius_mm": 3.0, "pitch_mm": 1.0, "stock_to_leave_mm": 0.2},
        {"radius_mm": 3.0, "pitch_mm": 0.5},
    ],
}
BESIDE: dict[str, dict[str, Any]] = {  # what a key needs in order to be looked at
    "plan": {"preset": "recommended", "passes": []},
    "image.prepare_detail_mm": {"image.prepare": "detail"},
    "optics.light.size_deg": {"optics.light.kind": "sun"},
    "optics.light.size_mm": {"optics.light": {"kind": "point", "distance_mm": 300.0}},
    "optics.light.distance_mm": {"optics.light.kind": "point"},
    "passes.0.shank_radius_mm": {"passes.0.flute_length_mm": 15.0},
    "finish.k0_rad_per_mm": {"finish.order": 2.0},
    "finish.order": {"finish.k0_rad_per_mm": 3.0},
    "finish": {"finish.process": "felt"},
    "stock.clamps.0": {
        "stock.clamps": [{"x_mm": -30.0, "y_mm": 0.0, "width_mm": 5.0, "depth_mm": 5.0, "height_mm": 3.0}]
    },
    "machine.blend_tolerance_mm": {"machine.profile": "linuxcnc"},
}


def numbers(schema: dict[str, Any] = SCHEMA, place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every number that a spec can hold: its key and its schema. Of a list, its first."""
    if "$ref" in schema:
        schema = SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]]
    for one in schema.get("anyOf", ()):
        yield from numbers(one, place)
    if schema.get("type") in ("number", "integer"):
        yield place, schema
    for name, inner in schema.get("properties", {}).items():
        yield from numbers(inner, f"{place}.{name}".lstrip("."))
    if "items" in schema:
        yield from numbers(schema["items"], f"{place}.0")


LISTED_BY_A_RULE = (  # checked whole, by a validator of their own
    "optics.outline.0.0", "optics.light.profile.0.0",
    "optics.light.spectrum.centre_nm", "optics.light.spectrum.width_nm",
)  # fmt: skip
NUMBERS = {key: told for key, told in numbers() if key not in LISTED_BY_A_RULE}
FLOATS = sorted(key for key, told in NUMBERS.items() if told["type"] == "number")


def spec_with(key: str, value: float) -> dict[str, Any]:
    data: dict[str, Any] = {name: _copy(table) for name, table in BASE.items()}
    for place, beside in BESIDE.items():
        if key == place or key.startswith(f"{place}."):
            for name, given_value in beside.items():
                _put(data, name.split("."), given_value)
    *steps, last = key.split(".")
    if last == "0":  # a list of numbers: all of them
        told = next(one for one in _at(".".join(steps)) if "minItems" in one)
        _put(data, steps, [value] * told["minItems"])
    else:
        _put(data, key.split("."), value)
    return data


def _copy(data: Any) -> Any:
    if isinstance(data, dict):
        return {name: _copy(value) for name, value in data.items()}
    return [_copy(value) for value in data] if isinstance(data, list) else data


def _put(data: Any, steps: list[str], value: Any) -> None:
    for step in steps[:-1]:
        data = data[int(step)] if isinstance(data, list) else data.setdefault(step, {})
    data[int(steps[-1]) if isinstance(data, list) else steps[-1]] = value


def _at(key: str) -> Iterator[dict[str, Any]]:
    """The schemas of a key, with what `anyOf` and references hide."""
    found = [SCHEMA]
    for step in key.split("."):
        opened = [_open(one) for inner in found for one in (inner, *inner.get("anyOf", ()))]
        found = [one["properties"][step] for one in opened if step in one.get("properties", {})]
    for one in found:
        yield from (_open(inner) for inner in (one, *one.get("anyOf", ())))


def _open(schema: dict[str, Any]) -> dict[str, Any]:
    return SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]] if "$ref" in schema else schema


def test_every_number_has_a_least_and_a_most() -> None:
    assert len(FLOATS) > 50
    for key, told in NUMBERS.items():
        assert -MOST < told["minimum"] < told["maximum"] < MOST, key
        assert told["minimum"] <= 0 or told["minimum"] >= LEAST, key


BEYOND = (5e-324, 2.2e-308, 1e-300, 1e-12, -1e-300, 1e300, -1e300, 1.7e308, math.inf, -math.inf, math.nan)


@pytest.mark.parametrize("key", FLOATS)
def test_no_number_beyond_all_measure_is_taken(key: str) -> None:
    for value in BEYOND:
        with pytest.raises(SpecError) as caught:
            resolve_job(base=spec_with(key, value))
        told = caught.value.problems
        assert any(place.startswith(key.removesuffix(".0")) for place, _ in told), (value, told)
        assert all("\n" not in words for _, words in told)


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("picture") / "p.png"
    ramp = np.linspace(40, 200, 24)
    Image.fromarray(np.add.outer(ramp / 2, ramp / 2).astype(np.uint8)).save(path)
    return path


def answer(picture: Path, key: str, value: float) -> str:
    """Estimate the spec as the server does; return what came of it. Anything else that is raised is a 500."""
    try:
        job = resolve_job(base=spec_with(key, value))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            found = estimate(job, picture, limits=OWN_PICTURE, name=picture.name)
    except ServiceError as error:
        assert str(error)
        return "refused"
    for name in ("relief_mm", "hours", "blur_mm"):
        assert math.isfinite(found[name]), (name, found[name])
    return "answered"


COSTLY = ("image.pixels", "optics.vertices_per_pixel")  # their upper ends are lenses of a gigabyte
ENDS = [
    (key, told[end])
    for key, told in sorted(NUMBERS.items())
    for end in ("minimum", "maximum")
    if (key, end) not in [(costly, "maximum") for costly in COSTLY]
]


@pytest.mark.thorough
@pytest.mark.parametrize(("key", "value"), ENDS)
def test_an_estimate_at_the_end_of_a_range_answers_or_refuses_in_words(picture: Path, key: str, value: float) -> None:
    assert answer(picture, key, value) in ("answered", "refused")


@settings(max_examples=12, deadline=None)
@given(end=st.sampled_from([end for end in ENDS if end[0].startswith(("optics", "stock", "image"))]))
def test_an_estimate_with_any_number_at_its_end_does_not_break(picture: Path, end: tuple[str, float]) -> None:
    assert answer(picture, *end) in ("answered", "refused")
