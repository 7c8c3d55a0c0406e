"""On a healthy link no program ever stalls; a dead controller is found within a stated time, whatever it was doing."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from machines.driver import FaultCause, Faulted, MillState, Override, ProgramDone, Stopped
from machines.errors import NotAllowedError
from machines.grbl.flow_control import COUNT_EVERY_S, COUNT_LATE_S
from machines.grbl.timeouts import IDLE_S, REPORT_SILENCE_S
from machines.simulated.faults import Fault, Faults
from machines.simulated.traits import FLUIDNC, GRBL_11, GRBL_11_ECHO, GRBLHAL, Traits
from tests.machines.grbl.bench import Bench, numbered, spiral

Block = bytes
PLACE = st.integers(0, 40).map(lambda n: n / 2)
FEED = st.sampled_from([20, 100, 600, 3000, 5000])


@st.composite
def pieces(draw: st.DrawFn) -> list[Block]:
    """Some blocks of one sort; every piece begins wherever the last one ended."""
    kind = draw(st.sampled_from(["zigzag", "far", "arc", "circles", "tiny", "dwell", "spindle", "sync", "stop"]))
    feed, x, y = draw(FEED), draw(PLACE), draw(PLACE)
    count = draw(st.integers(1, 45))
    if kind == "zigzag":
        width = draw(st.sampled_from([0.01, 0.1, 1.0]))
        return [b"G1X%.3fY%.3fF%d" % (x + width * (k % 2), y + 0.01 * k, max(feed, 600)) for k in range(count)]
    if kind == "far":
        return [b"G%dX%.3fY%.3fF%d" % (draw(st.integers(0, 1)), x, y, feed), b"G1X%.3f" % (x + 5.0)]
    if kind == "arc":
        return [b"G1X%.3fY%.3fF600" % (x, y), b"G2X%.3fI5F%d" % (x + 10.0, feed), b"G3X%.3fI-5Z-0.5" % x]
    if kind == "circles":
        radius = draw(st.sampled_from([0.02, 0.2, 3.0]))
        return [b"G1X%.3fY%.3fF%d" % (x, y, max(feed, 600)), *[b"G2X%.3fY%.3fI%.3f" % (x, y, radius)] * min(count, 9)]
    if kind == "tiny":
        return [b"G1X%.3fY%.3fF%d" % (x + 0.001 * k, y, feed) for k in range(count)]
    if kind == "dwell":
        return [b"G4P%.2f" % draw(st.sampled_from([0.05, 3.0, 40.0]))]
    if kind == "spindle":
        return [b"M3S%d" % draw(st.integers(1, 9999))]
    return [b"M5"] if kind == "sync" else [b"M0"]


PROGRAMS = st.lists(pieces(), min_size=1, max_size=8).map(lambda many: [block for piece in many for block in piece])
WITH_BUFFER = GRBL_11.with_settings({10: 3})  # Bf: in every report
WINDING = [b"G1X%.2fY%.2fF3000" % (0.1 * (k % 2), 0.1 * k) for k in range(60)]


@pytest.mark.thorough
@settings(max_examples=60, deadline=None)
@given(
    PROGRAMS,
    st.sampled_from([10.0, 50.0, 400.0, 3000.0]),
    st.sampled_from([None, ("feed", 10), ("rapid", 25), ("feed", 200)]),
    st.floats(0.0, 20.0),
    st.booleans(),
    st.sampled_from([GRBL_11, GRBL_11_ECHO, GRBLHAL, FLUIDNC, WITH_BUFFER]),
)
@example([*WINDING, b"M5"], 400.0, None, 0.0, False, GRBL_11)
@example([*WINDING, *[b"G1X0Y%dF3000" % (k % 2) for k in range(60)], b"M5"], 400.0, None, 0.0, False, WITH_BUFFER)
@example([*WINDING, b"G2X0.1Y5.9I0J5F3000", b"M5"], 10.0, ("feed", 10), 1.0, True, GRBL_11)
def test_no_program_stalls_on_a_healthy_link(
    blocks: list[Block],
    acceleration: float,
    override: tuple[str, int] | None,
    hold_at_s: float,
    holds: bool,
    traits: Traits,
) -> None:
    bench = Bench(traits.with_settings({120: acceleration, 121: acceleration, 122: acceleration / 2})).connected()
    bench.start(numbered([b"G21G90G94G17", b"G1X0Y0Z0F600", *blocks, b"M2"]))
    begin_s = bench.mill.now_s
    if override is not None:
        bench.driver.command(Override(*override))
    if holds:
        bench.pass_time(hold_at_s)
        bench.driver.hold()
        bench.pass_time(15.0)
    while not bench.of(ProgramDone) and not bench.of(Faulted):
        bench.pass_time(1.0)
        if bench.state() in (MillState.TOOL, MillState.HELD):
            try:
                bench.driver.resume()
            except NotAllowedError:
                continue
        assert bench.mill.now_s < begin_s + 40_000.0
    assert not bench.of(Faulted), bench.of(Faulted)


@settings(max_examples=25, deadline=None)
@given(PROGRAMS, st.floats(0.1, 30.0))
def test_a_controller_that_falls_silent_is_found_whatever_it_does(blocks: list[Block], at_s: float) -> None:
    """Power of its processor gone, cable and adapter still there: no answer to '?' any more."""
    bench = Bench().connected()
    long = [b"G1X100Y100F30", b"G4P100"]
    bench.start(numbered([b"G21G90G94G17", b"G1X0Y0Z0F600", *blocks, *long, b"M2"]))
    bench.pass_time(at_s)
    if bench.state() in (MillState.TOOL, MillState.HELD) or bench.of(ProgramDone):
        return
    bench.mill._off = True
    dead_s = bench.mill.now_s
    assert bench.until(lambda: bench.of(Faulted), 2 * REPORT_SILENCE_S)
    assert bench.of(Faulted)[0].cause is FaultCause.STALL
    assert bench.mill.now_s - dead_s < REPORT_SILENCE_S + 0.5


@pytest.mark.parametrize("line", [12, 150, 400])
def test_a_lost_answer_is_found_when_answers_are_counted(line: int) -> None:
    """Not at the end of the program, but with the next count; and nothing is claimed that was not cut."""
    lines, points = spiral(3000)
    bench = Bench(faults=(Fault(kind="lose-reply", line=line),)).connected()
    bench.start(lines)
    assert bench.until(lambda: bench.mill.faults.log, 60.0)
    lost_s = bench.mill.now_s
    assert bench.until(lambda: bench.of(Faulted) or bench.of(ProgramDone), 120.0)
    assert bench.of(Faulted) and bench.of(Faulted)[0].cause in (FaultCause.STALL, FaultCause.REPLY_COUNT)
    assert bench.mill.now_s - lost_s < COUNT_EVERY_S + IDLE_S + 3.0
    words = bench.of(Faulted)[0].words
    agreed = 0 if "after the start" in words else int(words.partition(" after line ")[2].split()[0])
    assert 0 <= agreed <= line  # the last count before it
    assert bench.until(lambda: bench.of(Stopped), 10.0)
    assert 0 <= bench.last_whole(points) - (bench.driver.progress.executed_line - 6) <= 17


FINE = [b"G21G90G94G17G1F1500", *(b"X%.3fY%.3f" % (0.03 * (k % 997), 0.01 * (k % 2)) for k in range(24000)), b"M2"]


@pytest.mark.parametrize("kind", ["lose-reply", "duplicate"])
def test_in_fine_segments_an_answer_too_few_or_too_many_is_found_within_seconds(kind: str) -> None:
    """No planner cover for a count there; a doubled line end is answered twice, and the window would overflow."""
    bench = Bench().connected()
    bench.start(numbered(FINE))
    bench.pass_time(5.0)
    bench.mill.arm(Faults((Fault(kind=kind, line=5),)))  # of the line end itself, where it is doubled
    bench.until(lambda: bench.mill.faults.log, 10.0)
    begin_s = bench.mill.now_s
    assert bench.until(lambda: bench.of(Faulted), 60.0)
    assert bench.mill.now_s - begin_s < COUNT_EVERY_S + COUNT_LATE_S + IDLE_S + 2.0
    assert bench.mill.serial.lost_overflow == 0
    assert bench.of(Faulted)[0].cause in (FaultCause.STALL, FaultCause.REPLY_COUNT)


@pytest.mark.parametrize("line", [40, 90, 150])
def test_an_answer_that_came_twice_shows_in_the_buffer_at_once(line: int) -> None:
    """With Bf: in the reports ($10=3) nobody waits for the next count, and the buffer never overflows."""
    lines, points = spiral(2000)
    bench = Bench(WITH_BUFFER, faults=(Fault(kind="duplicate-reply", line=line),)).connected()
    bench.start(lines)
    assert bench.until(lambda: bench.mill.faults.log, 60.0)
    doubled_s = bench.mill.now_s
    assert bench.until(lambda: bench.of(Faulted), 60.0)
    assert bench.of(Faulted)[0].cause is FaultCause.REPLY_COUNT
    assert "came twice" in bench.of(Faulted)[0].words
    assert bench.mill.now_s - doubled_s < 1.5
    assert bench.mill.serial.lost_overflow == 0
    assert bench.until(lambda: bench.of(Stopped), 10.0)
    assert 0 <= bench.last_whole(points) - (bench.driver.progress.executed_line - 6) <= 17


def test_counting_does_not_slow_the_mill() -> None:
    """The planner holds what is cut meanwhile: the same program without counts takes the same time."""

    def seconds() -> float:
        lines, _ = spiral(3000)
        bench = Bench().connected()
        bench.start(lines)
        begin_s = bench.mill.now_s
        assert bench.until(lambda: bench.of(ProgramDone), 300.0)
        return bench.mill.now_s - begin_s

    with_counts = seconds()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("machines.grbl.flow_control.COUNT_EVERY_S", 1e9)
        assert seconds() == pytest.approx(with_counts, abs=0.15)
    assert with_counts > 4 * COUNT_EVERY_S
