"""Every spec of examples/ is a complete job; a resolved spec, written as what has to be asked for to get it again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.profile import load_profile
from service.cli.main import run
from service.errors import SpecError
from service.job.spec import loading as module
from service.job.spec.loading import reduce_spec, resolve_spec

EXAMPLES = Path(__file__).parents[4] / "examples"
EXAMPLE_SPECS = sorted((EXAMPLES / "specs").glob("*.toml"))
SIZE = st.floats(10, 300).map(lambda value: round(value, 1))
PASS = st.fixed_dictionaries(
    {"radius_mm": st.sampled_from([0.5, 3.0]), "pitch_mm": st.sampled_from([0.05, 0.2])},
    optional={"stock_to_leave_mm": st.just(0.2), "feed_mm_per_min": st.just(600.0), "direction": st.just("y")},
)
SPECS = st.fixed_dictionaries(
    {},
    optional={
        "preset": st.sampled_from(["paper", "draft", "recommended"]),
        "image": st.fixed_dictionaries({}, optional={"pixels": st.integers(64, 512), "invert": st.booleans()}),
        "optics": st.fixed_dictionaries(
            {},
            optional={
                "width_mm": SIZE,
                "throw_mm": SIZE,
                "min_radius_mm": st.sampled_from([0.0, 0.5, 3.0]),
                "light": st.sampled_from([{"kind": "sun"}, {"kind": "point", "distance_mm": 800.0}]),
                "foreseen_blur_mm": st.just([0.1, 0.2]),
            },
        ),
        "stock": st.fixed_dictionaries({}, optional={"margin_mm": st.sampled_from([8.0, 14.0, 20.0])}),
        "machine": st.fixed_dictionaries({}, optional={"profile": st.sampled_from(["grbl", "grbl-3018"])}),
        "passes": st.lists(PASS, min_size=1, max_size=2),
    },
)


def test_there_are_some() -> None:
    assert len(EXAMPLE_SPECS) >= 6


@pytest.mark.parametrize("spec", EXAMPLE_SPECS, ids=lambda path: path.stem)
def test_an_example_is_a_complete_job_that_says_what_it_is(spec: Path) -> None:
    resolve_spec(file=spec)
    assert spec.read_text().startswith("# ")


@pytest.mark.thorough
@pytest.mark.parametrize("spec", EXAMPLE_SPECS, ids=lambda path: path.stem)
def test_an_example_makes_a_lens_without_a_warning(spec: Path, tmp_path: Path) -> None:
    """With few pixels: what such a lens can show, each example shows: 27 dB is plainly the picture."""
    picture = EXAMPLES / ("logo.png" if spec.stem == "black" else "camera.png")
    arguments = ["--spec", str(spec), "--set", "image.pixels=64", "--quiet"]
    assert run(["design", str(picture), "-o", str(tmp_path / "out"), *arguments]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["warnings"] == []
    assert report["optics"]["converged"]
    assert report["optics"]["psnr_db"] > 27


def resolved(spec: dict[str, Any]) -> dict[str, Any]:
    return resolve_spec(base=spec).model_dump(mode="json")


def leaves(value: Any) -> int:
    if isinstance(value, dict):
        return sum(map(leaves, value.values()))
    return sum(map(leaves, value)) if isinstance(value, list) else 1


@pytest.mark.thorough
@given(SPECS)
@settings(max_examples=25, deadline=None)
def test_it_resolves_to_the_same_and_is_no_longer_than_what_a_person_asked_for(spec: dict[str, Any]) -> None:
    try:
        wanted = resolved(spec)
    except SpecError:
        return
    asked = reduce_spec(wanted)
    assert resolved(asked) == wanted
    assert leaves(asked) <= leaves(spec)


@pytest.mark.parametrize(
    "spec",
    [
        {},
        {"preset": "draft", "optics": {"width_mm": 30.0}},
        {"passes": [{"radius_mm": 0.5, "pitch_mm": 0.05}]},
        {"optics": {"light": {"kind": "point", "distance_mm": 800.0}}},
    ],
)
def test_it_is_exactly_what_stands_out(spec: dict[str, Any]) -> None:
    assert reduce_spec(resolved(spec)) == spec


def test_nothing_is_tried_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each try costs a millisecond: what has gone with its table is not tried, and the mill's profile is read once."""
    read: list[str] = []
    monkeypatch.setattr(module, "load_profile", lambda name: read.append(name) or load_profile(name))
    tries: list[dict[str, Any]] = []
    resolve = resolve_spec
    monkeypatch.setattr(module, "resolve_spec", lambda base, load: tries.append(base) or resolve(base=base, load=load))
    whole = resolved({})
    assert reduce_spec(whole) == {}
    assert read == ["grbl"] and len(tries) == 1 + len(whole)


def test_a_spec_of_another_time_is_given_back_whole() -> None:
    """It cannot be resolved any more: its keys may have gone, its machine may be unknown."""
    stale = resolved({}) | {"machine": {"profile": "sold-in-2025", "step_mm": None}}
    assert reduce_spec(stale)["machine"] == {"profile": "sold-in-2025"}
    assert reduce_spec(stale)["optics"]["width_mm"] == 100.0
