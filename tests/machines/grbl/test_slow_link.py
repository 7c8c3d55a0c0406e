"""A link that takes long for every byte runs every program, and is stopped without losing the position."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.driver import CheckMode, CommandDone, Faulted, MillState, Notice, Override, ProgramDone, Stopped
from machines.errors import NotAllowedError
from machines.grbl.driver import GrblDriver
from machines.mill.mill import Mill
from machines.recovery.plan_model import Reentry
from machines.runs import START_CHECKS, Confirmation, RunState
from machines.simulated.endpoints import MemoryPort
from machines.simulated.mill import SimulatedMill
from machines.simulated.traits import FLUIDNC, GRBL_11, GRBLHAL, Traits
from tests.machines.grbl.bench import Bench, Tap, numbered, spiral
from tests.trials.kill_program import facts_of

DELAYS_S = (0.0, 0.3, 0.4, 0.6, 1.0, 1.5)


class DelayedLink(Tap):
    """Hands every byte over `delay_s` later, each way, in order; the throughput is whole."""

    def __init__(self, port: MemoryPort, delay_s: float) -> None:
        super().__init__(port)
        self.delay_s = delay_s
        self.there: deque[tuple[float, bytes]] = deque()
        self.back: deque[tuple[float, bytes]] = deque()

    def write(self, data: bytes) -> None:
        self.written.append((self.clock(), bytes(data)))
        self.there.append((self.clock() + self.delay_s, bytes(data)))

    def read(self, timeout_s: float) -> bytes:
        mill, end_s = self.port.mill, self.clock() + max(timeout_s, 0.0)
        while True:
            while self.there and self.there[0][0] <= mill.now_s:
                self.port.write(self.there.popleft()[1])
            if data := mill.output():
                self.back.append((mill.now_s + self.delay_s, data))
            ready = b""
            while self.back and self.back[0][0] <= mill.now_s:
                ready += self.back.popleft()[1]
            if ready or mill.now_s >= end_s:
                return ready
            due_s = [one[0][0] for one in (self.there, self.back) if one]
            mill.advance(max(min([end_s, *due_s]), mill.now_s + 1e-6), until_output=True)


def slow_bench(delay_s: float, traits: Traits = GRBL_11) -> Bench:
    bench = Bench(traits, baud=None, link=lambda port: DelayedLink(port, delay_s))
    bench.driver.connect()
    assert bench.until(lambda: bench.state() is MillState.IDLE, 60.0), bench.driver.status
    bench.pass_time(2.0)  # the work offset comes with every tenth report
    return bench


def blames(bench: Bench) -> list[object]:
    """What was said that is not true of a healthy, slow link."""
    untrue = ("no answer", "does not confirm", "not understood", "no banner")
    return [*bench.of(Faulted), *(one for one in bench.of(Notice) if any(word in one.words for word in untrue))]


@settings(max_examples=25)
@given(
    delay_s=st.floats(0.0, 1.5),
    traits=st.sampled_from([GRBL_11, GRBLHAL, FLUIDNC]),
    segment_mm=st.sampled_from([0.05, 1.0, 8.0]),
    hold_at=st.integers(0, 40),
)
def test_a_program_runs_at_every_delay(delay_s: float, traits: Traits, segment_mm: float, hold_at: int) -> None:
    """It runs dry between its lines, is held and resumed, and every segment is cut once."""
    bench = slow_bench(delay_s, traits)
    turns = [b"G1X%.3fY%.3fF1500" % (segment_mm * (k % 7 + 1), segment_mm * (k // 7)) for k in range(60)]
    bench.start(numbered([b"G21G90G94G17", *turns, b"G4P1", b"M3S1000", b"G0X0", b"M2"]))
    bench.until(lambda: bench.driver.progress.answered_line >= hold_at, 300.0)
    if not bench.of(ProgramDone):
        bench.driver.hold()
        assert bench.until(lambda: bench.state() is MillState.HELD or bench.of(ProgramDone), 20.0)
        if not bench.of(ProgramDone):
            bench.driver.resume()
    assert bench.until(lambda: bench.of(ProgramDone) or bench.of(Faulted), 600.0)
    assert not blames(bench)
    assert len([cut for cut in bench.mill.recording.cuts() if cut.whole]) == len(turns)


@pytest.mark.parametrize("delay_s", DELAYS_S)
@pytest.mark.parametrize("resumed", [False, True])
def test_an_abort_keeps_the_position(delay_s: float, resumed: bool) -> None:
    """No reset goes out for reports that were made before the '!' arrived: the mill may move by then."""
    bench = slow_bench(delay_s)
    bench.start(spiral(400, turn_rad=0.3)[0])
    bench.until(lambda: bench.driver.progress.answered_line > 20, 120.0)
    if resumed:  # it goes on while reports of a standing mill are still on their way
        bench.driver.hold()
        assert bench.until(lambda: bench.state() is MillState.HELD, 20.0)
        bench.driver.resume()
        bench.pass_time(0.05)
    bench.driver.abort()
    assert bench.until(lambda: bench.of(Stopped), 30.0)
    assert bench.of(Stopped)[0].position_kept
    assert bench.until(lambda: bench.state() is MillState.IDLE, 60.0), bench.driver.status
    assert not blames(bench) and bench.mill.firmware.alarm == 0


@pytest.mark.parametrize("delay_s", [1.2, 1.5])
def test_an_abort_of_a_move_that_is_not_reported_yet_keeps_the_position(delay_s: float) -> None:
    """The mill is said to be idle, but it moves by now, and takes long to stop."""
    bench = slow_bench(delay_s, GRBL_11.with_settings({120: 10, 121: 10, 122: 10}))
    bench.start(numbered([b"G21G90G94G17", b"G1X150F5000", b"M2"]))
    bench.pass_time(1.1 * delay_s)
    bench.driver.abort()
    assert bench.until(lambda: bench.of(Stopped), 60.0)
    assert bench.of(Stopped)[0].position_kept and not blames(bench)


@pytest.mark.parametrize("delay_s", DELAYS_S)
@pytest.mark.parametrize("percent", [60, 111, 180])
def test_an_override_goes_nowhere_beyond_what_was_asked(delay_s: float, percent: int) -> None:
    bench = slow_bench(delay_s)
    bench.driver.command(Override("feed", percent))
    seen = [100]
    end_s = bench.mill.now_s + 120.0
    while not bench.of(CommandDone) and bench.mill.now_s < end_s:
        bench.events += bench.driver.poll(0.05)
        seen.append(bench.mill.firmware.feed_percent)
    assert [one.failure for one in bench.of(CommandDone)] == [""]
    assert seen[-1] == percent
    assert min(100, percent) <= min(seen) and max(seen) <= max(100, percent)


@pytest.mark.parametrize("delay_s", DELAYS_S)
def test_check_mode_ends_with_a_banner_that_is_expected(delay_s: float) -> None:
    bench = slow_bench(delay_s)
    bench.driver.command(CheckMode(True))
    assert bench.until(lambda: bench.state() is MillState.CHECK, 30.0)
    bench.driver.command(CheckMode(False))
    assert bench.until(lambda: bench.state() is MillState.IDLE and len(bench.of(CommandDone)) == 2, 60.0)
    assert not blames(bench)


@pytest.mark.parametrize("delay_s", DELAYS_S)
def test_a_slow_link_is_told_of_before_a_program_starts(delay_s: float) -> None:
    bench = slow_bench(delay_s)
    told = [one.words for one in bench.of(Notice) if "the link takes" in one.words]
    assert len(told) == (2.0 * delay_s > 0.25)
    assert ("the link takes" in bench.driver.facts.capacity) == bool(told)


def test_what_the_link_is_busy_with_is_named_and_not_the_mill() -> None:
    bench = slow_bench(1.0)
    bench.driver.command(CheckMode(True))
    with pytest.raises(NotAllowedError, match="start: the link is busy"):
        bench.start(numbered([b"G0X1"]))


@pytest.mark.parametrize("delay_s", DELAYS_S)
def test_a_start_that_a_person_ordered_is_still_in_time(delay_s: float, tmp_path: Path) -> None:
    """What the controller is asked before a start fits into the time of an order."""
    path = tmp_path / "p.nc"
    path.write_text("G21G90G94G17G54\nM3S8000\nG0Z5\nG0X1Y1\nG1Z-0.1F200\nG1X5F600\nG0Z5\nM5\nM2\n")
    sim = SimulatedMill(GRBL_11)
    mill = Mill(
        name="sim",
        reentry=Reentry(safe_z_mm=5.0),
        connect=lambda: GrblDriver(DelayedLink(MemoryPort(sim, baud=None), delay_s)),
        folder=tmp_path / "mill",
        clock=lambda: sim.now_s,
        wall_clock=lambda: 1.8e9 + sim.now_s,
        pause=lambda seconds: sim.advance(sim.now_s + seconds),
    )
    facts = facts_of(path)

    def until(done: object) -> None:
        end_s = sim.now_s + 200.0
        while not done():  # type: ignore[operator]
            assert sim.now_s < end_s, mill.snapshot
            mill.step(0.1)

    until(lambda: mill.status.state is MillState.IDLE and mill.status.work_mm is not None)
    run = mill.park(facts, path, "part").id
    begun_s = sim.now_s
    mill.start(run, Confirmation(operator="a person", checks=START_CHECKS))
    assert sim.now_s - begun_s < 10.0  # machines.mill.orders.CARRY_OUT_S
    until(lambda: mill.run(run).state is RunState.FINISHED)
    mill.close()
