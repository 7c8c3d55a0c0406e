"""Executed is what is proven; off the path is what no line can explain."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.grbl.tracking import LONG_BLOCKS_BEYOND_PLANNER, SEGMENTS, Place, Tracker

SHORT_BEYOND = SEGMENTS["grbl"] + 1
START = b"G21G90G94G17G1X0Y0Z0F600"


def tracker_of(*blocks: bytes, answered: int | None = None) -> Tracker:
    """Line 1 is a move to the origin, then `blocks`."""
    tracker, interpreter = (
        Tracker(planner_blocks=15, tolerance_mm=0.02),
        Interpreter(ModalState(position_mm=(0.0, 0.0, 0.0))),
    )
    for number, block in enumerate((START, *blocks), 1):
        tracker.note_sent(number, interpreter.take(block))
    for _ in range(len(blocks) + 1 if answered is None else answered):
        tracker.take_answer()
    return tracker


def test_an_answer_alone_proves_nothing() -> None:
    assert tracker_of(b"X10", b"X20").executed_line == 0


def test_a_position_proves_the_lines_before_it() -> None:
    tracker = tracker_of(b"X10", b"X20", b"X30")
    assert tracker.take_report((25.0, 0.0, 0.0)).place is Place.ON_PATH
    assert tracker.executed_line == 3  # the move to 30 is under way


def test_where_a_position_fits_two_lines_the_earlier_is_believed() -> None:
    tracker = tracker_of(b"X10", b"X0", b"X10")
    tracker.take_report((5.0, 0.0, 0.0))
    assert tracker.executed_line == 1


def test_a_corner_belongs_to_the_move_that_ends_there() -> None:
    tracker = tracker_of(b"X10", b"Y10")
    tracker.take_report((10.0, 0.0, 0.0))
    assert tracker.executed_line == 1


def test_off_the_path_names_the_distance() -> None:
    sight = tracker_of(b"X10", b"X20").take_report((12.0, 1.5, 0.0))
    assert (sight.place, sight.line, round(sight.distance_mm, 6)) == (Place.OFF_PATH, 3, 1.5)


def test_back_on_what_is_executed_is_off_the_path() -> None:
    """No mill goes back: a damaged block may, along a row that is cut already."""
    tracker = tracker_of(*(b"X%d" % (2 * k) for k in range(1, 31)))
    assert tracker.take_report((41.0, 0.0, 0.0)).place is Place.ON_PATH
    assert tracker.take_report((37.0, 0.0, 0.0)).place is Place.ON_PATH  # a step back may be the end of tiny ones
    assert tracker.take_report((25.0, 0.0, 0.0)).place is Place.OFF_PATH


def test_after_a_place_off_the_path_only_counts_prove_anything() -> None:
    """A damaged block that crosses later lines by chance has not cut them."""
    tracker = tracker_of(*(b"X%d" % (2 * k) for k in range(1, 31)))
    counted = tracker.executed_line
    assert counted == 31 - 15 - LONG_BLOCKS_BEYOND_PLANNER
    tracker.take_report((55.0, 0.0, 0.0))
    assert tracker.executed_line > counted
    tracker.distrust_positions()
    assert tracker.executed_line == counted
    tracker.take_report((57.0, 0.0, 0.0))
    assert tracker.executed_line == counted


def test_rounding_of_reports_is_not_off_the_path() -> None:
    assert tracker_of(b"X10Y3.3333").take_report((5.001, 1.666, 0.001)).place is Place.ON_PATH


def test_a_place_on_lines_that_were_never_answered_is_a_lost_reply() -> None:
    tracker = tracker_of(b"X10", b"X20", b"X30", b"X40", answered=3)
    assert tracker.take_report((35.0, 0.0, 0.0)).place is Place.UNANSWERED


def test_standing_before_the_first_move_is_no_lost_reply() -> None:
    """Re-entry: modes and spindle are answered, the first move is not; the mill stands where that move will begin."""
    tracker, interpreter = (
        Tracker(planner_blocks=15, tolerance_mm=0.02),
        Interpreter(ModalState(position_mm=(9.0, 0.0, 5.0))),
    )
    for block in (b"G21G90G94G17", b"M3S1000", b"G4P3", b"G0Z5", b"G0X1"):
        tracker.note_sent(0, interpreter.take(block))
    tracker.take_answer()
    tracker.take_answer()
    assert tracker.take_report((9.0, 0.0, 5.0)).place is not Place.UNANSWERED


def test_the_first_unanswered_line_may_be_under_way() -> None:
    """An arc is answered when its last chord is queued, long after its first has begun."""
    tracker = tracker_of(b"X10", b"G2X20I5", answered=2)
    assert tracker.take_report((15.0, 5.0, 0.0)).place is Place.ON_PATH
    assert tracker.executed_line == 2


def test_an_answered_wait_for_standstill_proves_everything_before_it() -> None:
    assert tracker_of(b"X10", b"G4P1").executed_line == 3
    assert tracker_of(b"X10", b"M2").executed_line == 3


@pytest.mark.parametrize("block", [b"M5", b"M3", b"M9", b"M8", b"G54", b"S0", b"M3S1000"])
def test_a_word_that_may_change_nothing_proves_nothing(block: bytes) -> None:
    """M5 with the spindle off already is answered at once, with twenty blocks still to be cut."""
    assert tracker_of(b"X10", block).executed_line == 0


@given(
    st.integers(1, 120), st.sampled_from([("X%.2f", 0.03, SHORT_BEYOND), ("X%.2f", 2.0, LONG_BLOCKS_BEYOND_PLANNER)])
)
def test_what_the_buffers_cannot_hold_is_executed(count: int, kind: tuple[str, float, int]) -> None:
    """Planner (15) and segment buffer: 2 more blocks where they are long, 7 where they last less than 0.12 s."""
    pattern, length_mm, beyond = kind
    tracker = tracker_of(*((pattern % (length_mm * k)).encode() for k in range(1, count + 1)))
    executed = count - 15 - beyond
    assert tracker.executed_line == (1 + executed if executed > 0 else 0)  # line 1 moves nothing


@given(st.lists(st.sampled_from([b"move", b"M5", b"F600", b"G54", b"again", b"M9"]), max_size=120))
def test_lines_that_move_nothing_take_no_place_in_a_buffer(kinds: list[bytes]) -> None:
    """However many are between: the last 17 lines that move may still have to be cut."""
    x_mm, blocks, moving = 0, [], []
    for number, kind in enumerate(kinds, 2):
        if kind == b"move":
            x_mm += 2
            moving.append(number)
        blocks.append(b"X%d" % x_mm if kind in (b"move", b"again") else kind)
    tracker = tracker_of(*blocks)
    ahead = 15 + LONG_BLOCKS_BEYOND_PLANNER
    assert tracker.executed_line == (moving[-ahead - 1] if len(moving) > ahead else 0)


@given(st.lists(st.integers(-12, 12), min_size=1, max_size=2500))
def test_creeping_moves_make_a_block_where_they_have_come_a_step_further(moves_um: list[int]) -> None:
    """The firmware makes a block of what changes a step count; the tracker never counts more of them."""
    step_um = 10
    places_um = list(itertools.accumulate(moves_um))
    tracker = tracker_of(*(b"X%.3f" % (um / 1000) for um in places_um))
    counts = [round(um / step_um) for um in places_um]
    made = [number for number, (a, b) in enumerate(itertools.pairwise([0, *counts]), 2) if a != b]
    ahead = 15 + SHORT_BEYOND
    assert tracker.executed_line <= (made[-ahead - 1] if len(made) > ahead else 0) or tracker.executed_line <= 1


def test_a_long_creep_is_not_remembered_for_ever() -> None:
    """Thousands of moves shorter than a step, to and fro over the same place."""
    blocks = [b"X%.3f" % (abs(k % 2000 - 1000) / 1000) for k in range(1, 8001)]
    tracker = tracker_of(*blocks)
    assert len(tracker._steps) < 1000
    assert tracker.executed_line > 7000


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=2, max_size=40), st.data())
def test_executed_never_passes_what_the_mill_has_done(corners: list[tuple[int, int]], data: st.DataObject) -> None:
    """A mill anywhere along any path, crossing itself or not: the tracker never claims the line under way."""
    tracker = tracker_of(*(b"X%dY%d" % corner for corner in corners))
    places = [(0, 0), *corners]
    done = 0
    for _ in range(6):
        done = data.draw(st.integers(done, len(corners) - 1))
        share = data.draw(st.sampled_from([0.0, 0.25, 0.5, 1.0]))
        (x0, y0), (x1, y1) = places[done], places[done + 1]
        sight = tracker.take_report((x0 + share * (x1 - x0), y0 + share * (y1 - y0), 0.0))
        assert sight.place is Place.ON_PATH
        assert tracker.executed_line <= max(1 + done, len(corners) + 1 - 17)


@pytest.mark.parametrize(
    ("blocks", "answered", "place", "executed"),
    [
        ((b"X10", b"X20", b"Y10", b"X0"), 5, (20.0, 0.0, 0.0), 3),  # the end of line 3 alone
        ((b"X10", b"X20", b"Y10", b"X0"), 5, (15.0, 0.0, 0.0), 0),  # within a line
        ((b"X10", b"X20", b"Y10", b"X0"), 2, (20.0, 0.0, 0.0), 0),  # that line was never answered
        ((b"X10", b"X20", b"X10", b"Y9"), 5, (10.0, 0.0, 0.0), 0),  # lines 2 and 4 end there
        ((b"X10", b"Y9", b"X0Y4", b"X20"), 5, (10.0, 9.0, 0.0), 3),
        ((b"X10", b"Y9", b"Y0", b"X20"), 5, (10.0, 0.0, 0.0), 0),  # and back again
        ((b"X10", b"X20", b"X5", b"Y9"), 5, (10.0, 0.0, 0.0), 0),  # line 4 comes by
    ],
)
def test_standing_at_the_end_of_one_line_and_no_other_proves_it(
    blocks: tuple[bytes, ...], answered: int, place: tuple[float, float, float], executed: int
) -> None:
    tracker = tracker_of(*blocks, answered=answered)
    tracker.take_standstill(place, exact_mm=0.005)
    assert tracker.executed_line == executed
