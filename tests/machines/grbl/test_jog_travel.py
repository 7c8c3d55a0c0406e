"""No jog leaves the known travel of a homed mill, whether its controller looks (soft limits) or not."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from machines.driver import Home, Jog, MillState, SendBlock
from machines.errors import NotAllowedError
from machines.grbl.permits import check_command
from machines.grbl.settings import ControllerSettings
from machines.grbl.states import Phase
from machines.simulated.traits import GRBL_11
from tests.machines.grbl.bench import Bench

TRAVEL_MM = (300.0, 200.0, 80.0)
places = st.tuples(st.floats(-320, 320), st.floats(-220, 220), st.floats(-100, 100))
steps = st.one_of(st.just(0.0), st.floats(-400, 400))


def told(**values: float) -> ControllerSettings:
    travel = {130 + axis: str(mm) for axis, mm in enumerate(TRAVEL_MM)}
    changed = {int(name[1:]): str(value) for name, value in values.items()}
    return ControllerSettings(values={20: "0", 22: "1", 23: "0"} | travel | changed)


def is_taken(by_mm: Any, at_mm: Any, known: ControllerSettings, *, trusted: bool = True) -> bool:
    jog = Jog(by_mm, 500.0)
    try:
        check_command(jog, MillState.IDLE, Phase.READY, known, machine_mm=at_mm, trusted=trusted, silent=False)
    except NotAllowedError:
        return False
    return True


@given(
    at_mm=places,
    by_mm=st.tuples(steps, steps, steps),
    soft=st.booleans(),
    forced=st.booleans(),
    ends=st.integers(0, 7),
)
@example(at_mm=(-1.0, -1.0, -1.0), by_mm=(1.5, 0.0, 0.0), soft=False, forced=False, ends=0)
@settings(max_examples=300, deadline=None)
def test_a_jog_ends_within_the_travel_or_nearer_to_it(
    at_mm: Any, by_mm: Any, soft: bool, forced: bool, ends: int
) -> None:
    known = dataclasses.replace(told(_20=int(soft), _23=ends), options="VZ,15,128" if forced else "V,15,128")

    def outside(place_mm: tuple[float, ...]) -> list[float]:
        reach = [(0.0, mm) if forced and ends >> axis & 1 else (-mm, 0.0) for axis, mm in enumerate(TRAVEL_MM)]
        return [max(0.0, low - p, p - high) for p, (low, high) in zip(place_mm, reach, strict=True)]

    before, after = outside(at_mm), outside(tuple(a + b for a, b in zip(at_mm, by_mm, strict=True)))
    harmless = all(new <= 0.01 or new <= old for old, new in zip(before, after, strict=True))
    assert is_taken(by_mm, at_mm, known) is harmless


@pytest.mark.parametrize(("homing", "trusted", "bounded"), [(1, True, True), (1, False, False), (0, True, False)])
def test_where_the_travel_is_not_known_a_jog_is_not_bounded(homing: int, trusted: bool, bounded: bool) -> None:
    """After a limit switch and an unlock the mill counts from anywhere, and has to be brought away."""
    assert is_taken((50.0, 0.0, 0.0), (-1.0, -1.0, -1.0), told(_22=homing), trusted=trusted) is not bounded
    assert is_taken((50.0, 0.0, 0.0), None, told(), trusted=True)


def test_grblhal_says_by_its_homing_setting_that_it_counts_from_zero() -> None:
    hal = dataclasses.replace(told(_22=9, _23=1), firmware="grblhal")
    assert hal.reach_mm == ((0.0, 300.0), (-200.0, 0.0), (-80.0, 0.0))
    assert told(_22=9, _23=1).reach_mm == ((-300.0, 0.0), (-200.0, 0.0), (-80.0, 0.0))


@pytest.mark.parametrize("soft", ["$20=0", "$20=1"])
def test_a_homed_mill_stays_within_its_travel(soft: str) -> None:
    """The controller takes every jog with $20=0: `$J=` beyond the end of an axis runs into it."""
    bench = Bench(dataclasses.replace(GRBL_11, homing=True, settings={24: 1000, 25: 5000})).connected()
    bench.driver.command(Home())
    assert bench.until(lambda: bench.state() is MillState.IDLE and bench.driver.status.position_trusted, 120.0)
    bench.do(SendBlock(soft))
    for by_mm in ((2.0, 0.0, 0.0), (0.0, -400.0, 0.0), (0.0, 0.0, 2.0), (-50.0, 5.0, 0.0)):
        with pytest.raises(NotAllowedError, match="reaches"):
            bench.driver.command(Jog(by_mm, 5000.0))
    for by_mm in ((-50.0, -20.0, -5.0), (49.0, 0.0, 0.0)):
        bench.do(Jog(by_mm, 5000.0))
    with pytest.raises(NotAllowedError, match="reaches"):  # of what a jog has left
        bench.driver.command(Jog((50.0, 0.0, 0.0), 5000.0))
    assert bench.driver.status.machine_mm == pytest.approx((-2.0, -21.0, -6.0), abs=0.005)
