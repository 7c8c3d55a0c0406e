"""A plate on the block's corner, touched from above, left and front: the zero is the corner's, or nothing is set."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from machines.driver import CommandDone, MillState, ProbeCorner, SetZero
from machines.errors import NotAllowedError
from machines.grbl.permits import check_command
from machines.grbl.sequences import APART_MM, find_reached_mm, find_zero_mm
from machines.grbl.settings import ControllerSettings
from machines.grbl.states import Phase
from machines.simulated.traits import GRBL_11, CornerPlate
from tests.machines.grbl.bench import Bench

STEP_MM = 1 / 250
TOP_MM = -5.0  # of the plate; the mill's tool begins at 0, 0, 0
ASKED = ProbeCorner(
    depth_mm=5.5,
    plate_mm=2.0,
    wall_x_mm=6.0,
    wall_y_mm=4.0,
    cutter_radius_mm=1.5,
    margin_mm=8.0,
    feed_mm_per_min=600.0,
)
WITHIN_S = 300.0
NONE = (0.0, 0.0, 0.0)

lengths = st.floats(0.0, 12.0).map(lambda mm: round(mm, 3))


def bench_with_plate(asked: ProbeCorner, left_mm: float = -7.0, front_mm: float = -9.0, **settings: float) -> Bench:
    """A mill whose tool stands over a plate, whose faces lie there."""
    plate = CornerPlate(left_mm=left_mm, front_mm=front_mm, tool_radius_mm=asked.cutter_radius_mm)
    traits = replace(GRBL_11, probe_surface_mm=TOP_MM, corner_plate=plate)
    return Bench(traits.with_settings({int(name[1:]): value for name, value in settings.items()})).connected()


def zero_mm(bench: Bench) -> tuple[float, ...]:
    """The work zero as the controller has stored it."""
    return tuple(bench.mill.firmware.interpreter.stored["G54"])


def corner_mm(asked: ProbeCorner, left_mm: float = -7.0, front_mm: float = -9.0) -> tuple[float, ...]:
    """Where X0 Y0 Z0 is in truth."""
    x, y = left_mm + asked.wall_x_mm + asked.margin_mm, front_mm + asked.wall_y_mm + asked.margin_mm
    return (x, y, TOP_MM - asked.plate_mm)


@settings(max_examples=25, deadline=None)
@given(left=lengths, front=lengths, walls=st.tuples(lengths, lengths), radius=st.floats(0.05, 3.0), margin=lengths)
def test_the_zero_set_is_the_corners_whatever_the_plate_the_cutter_and_the_start(
    left: float, front: float, walls: tuple[float, float], radius: float, margin: float
) -> None:
    asked = replace(ASKED, wall_x_mm=walls[0], wall_y_mm=walls[1], cutter_radius_mm=radius, margin_mm=margin)
    bench = bench_with_plate(asked, -left, -front)
    assert bench.do(asked, WITHIN_S).failure == ""
    bench.pass_time(2.0)
    assert zero_mm(bench) == pytest.approx(corner_mm(asked, -left, -front), abs=STEP_MM)
    assert bench.driver.status.machine_mm == pytest.approx((0.0, 0.0, TOP_MM + asked.retract_mm), abs=STEP_MM)
    reached = [segment.end for segment in bench.mill.recording.segments]
    for k, (low, high) in enumerate(find_reached_mm(asked, (0.0, 0.0, 0.0))):
        assert all(low - STEP_MM <= end[k] <= high + STEP_MM for end in reached)
    assert min(end[2] for end in reached) == pytest.approx(TOP_MM - asked.below_mm, abs=STEP_MM)
    beside = [end for end in reached if end[2] < TOP_MM - STEP_MM]
    assert all(end[0] <= -left - radius + STEP_MM or end[1] <= -front - radius + STEP_MM for end in beside)


def lose_clip(bench: Bench) -> None:
    bench.mill.firmware.traits = replace(bench.mill.firmware.traits, probe_surface_mm=None)


def short_clip(bench: Bench) -> None:
    bench.mill.firmware.traits = replace(bench.mill.firmware.traits, probe_surface_mm=1e6, corner_plate=None)


ENDS: dict[str, Callable[[Bench], None]] = {
    "hold": lambda bench: bench.driver.hold(),
    "abort": lambda bench: bench.driver.abort(),
    "clip lost": lose_clip,
    "clip shorted": short_clip,
    "unplugged": lambda bench: bench.mill.unplug(),
    "door": lambda bench: bench.mill.press("door"),
}


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(ENDS)), st.floats(0.0, 40.0))
@example("hold", 0.0)
@example("clip lost", 6.0)
def test_whatever_happens_in_the_midst_all_zeros_are_set_or_none(end: str, at_s: float) -> None:
    bench = bench_with_plate(ASKED)
    bench.driver.command(ASKED)
    bench.pass_time(at_s)
    if not bench.of(CommandDone):
        ENDS[end](bench)
    assert bench.until(lambda: bench.of(CommandDone), WITHIN_S)
    (done,) = bench.of(CommandDone)
    set_mm = zero_mm(bench)
    if done.failure:
        assert set_mm == NONE or set_mm == pytest.approx(corner_mm(ASKED), abs=STEP_MM)
        assert set_mm == NONE or end in ("hold", "abort", "unplugged", "door"), "set, and not told that it is"
    else:
        assert set_mm == pytest.approx(corner_mm(ASKED), abs=STEP_MM)


@pytest.mark.parametrize(
    ("changed", "said"), [({"probe_surface_mm": None}, "ALARM:5"), ({"probe_surface_mm": 1.0}, "ALARM:4")]
)
def test_a_plate_that_is_not_there_or_touched_from_the_start_sets_nothing(changed: dict[str, float], said: str) -> None:
    bench = Bench(replace(GRBL_11, **changed)).connected()
    assert said in bench.do(ASKED, WITHIN_S).failure and zero_mm(bench) == NONE
    assert {segment.end[:2] for segment in bench.mill.recording.segments} <= {(0.0, 0.0)}


def test_a_tool_that_comes_down_on_the_plate_stops_there_and_says_what_to_do() -> None:
    """It began farther from the plate's left face than it goes aside."""
    bench = bench_with_plate(ASKED, left_mm=-30.0)
    assert "begin nearer to the corner" in bench.do(ASKED, WITHIN_S).failure and zero_mm(bench) == NONE
    assert min(segment.end[2] for segment in bench.mill.recording.segments) >= TOP_MM - STEP_MM
    assert bench.mill.firmware.interpreter.modal["distance"] == "G90"


@pytest.mark.parametrize("early_mm", [0.1, 0.5])
def test_the_slow_touch_counts_and_one_far_from_the_fast_one_ends_it(early_mm: float) -> None:
    """The first touch comes too early, as by a chip, or by a spark in the air."""
    bench = bench_with_plate(ASKED)
    true = bench.mill.firmware.traits
    bench.mill.firmware.traits = replace(true, probe_surface_mm=TOP_MM + early_mm)
    bench.driver.command(ASKED)
    bench.until(lambda: any(b"G53" in data for _, data in bench.tap.written))
    bench.mill.firmware.traits = true
    assert bench.until(lambda: bench.of(CommandDone), WITHIN_S)
    failure = bench.of(CommandDone)[0].failure
    if early_mm < APART_MM:
        assert failure == "" and zero_mm(bench) == pytest.approx(corner_mm(ASKED), abs=STEP_MM)
    else:
        assert "was touched at" in failure and zero_mm(bench) == NONE


@given(st.tuples(st.floats(-310, 5), st.floats(-310, 5), st.floats(-90, 5)), st.booleans(), st.integers(0, 7))
@example((-1.0, -1.0, -5.0), True, 0)
@example((-280.0, -280.0, -69.5), True, 0)
@example((-280.1, -280.0, -69.5), True, 0)
@example((20.0, 20.0, 15.0), True, 7)
def test_what_might_leave_the_travel_is_refused(at: tuple[float, float, float], homing: bool, low_ends: int) -> None:
    """From wherever every move of the sequence is within it, it is allowed."""
    told = {22: homing, 130: 300, 131: 300, 132: 80, 23: low_ends}
    known = ControllerSettings(values={number: str(int(value)) for number, value in told.items()}, options="VZ,15,128")
    inside = True
    for k, ((least, most), mm) in enumerate(zip(find_reached_mm(ASKED, at), (300.0, 300.0, 80.0), strict=True)):
        inside &= (least >= 0.0 and most <= mm) if low_ends >> k & 1 else (least >= -mm and most <= 0.0)
    refused = contextlib.nullcontext() if inside or not homing else pytest.raises(NotAllowedError, match="might go")
    with refused:
        check_command(ASKED, MillState.IDLE, Phase.READY, known, machine_mm=at, trusted=True, silent=False)


def test_it_is_refused_where_the_mill_stands_too_near_to_its_end() -> None:
    bench = bench_with_plate(ASKED, s20=1.0)
    with pytest.raises(NotAllowedError, match="X might go from -20"):
        bench.driver.command(ASKED)
    assert not bench.mill.recording.segments


@pytest.mark.parametrize("changed", [{"below_mm": 1.5}, {"aside_mm": 1.0}])
def test_a_ball_that_would_not_touch_with_its_side_is_refused(changed: dict[str, float]) -> None:
    bench = bench_with_plate(ASKED)
    with pytest.raises(NotAllowedError, match="radius"):
        bench.driver.command(replace(ASKED, **changed))


def test_what_was_vouched_for_is_all_of_it() -> None:
    """Work coordinates are trusted as after a zero set by hand, and read back from the controller."""
    bench = bench_with_plate(ASKED)
    done = bench.do(ASKED, WITHIN_S)
    assert bench.driver.status.position_trusted
    assert done.answer["offsets"]["G54"] == pytest.approx(find_zero_mm(ASKED, tuple(done.answer["contact_machine_mm"])))
    assert bench.do(SetZero("Z")).failure == ""
