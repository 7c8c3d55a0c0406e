"""A healthy link is never blamed, however late we or its answers are; a dead one is found in so many looks."""

from __future__ import annotations

import random

import pytest

from machines.clock import LOOK_S, make_running_clock
from machines.driver import CheckMode, CommandDone, FaultCause, Faulted, MillState, Notice, ProgramDone, Stopped
from machines.grbl.timeouts import REPORT_SILENCE_S
from machines.simulated.endpoints import MemoryPort
from machines.simulated.traits import FLUIDNC, GRBL_11, GRBLHAL, Traits
from tests.machines.grbl.bench import Bench, Tap, numbered, spiral


class LateLink(Tap):
    """Now and then nothing is handed over for a while, then all at once: a driver, a network, a starved process."""

    chance: random.Random
    late_until_s = 0.0
    next_late_s = 1.0
    waiting = b""

    def read(self, timeout_s: float) -> bytes:
        self.waiting += self.port.read(timeout_s)
        now_s = self.port.clock()
        if now_s >= self.next_late_s:
            self.late_until_s = now_s + self.chance.choice([0.1, 1.0, 3.0, 20.0]) * self.chance.random()
            self.next_late_s = self.late_until_s + self.chance.choice([0.05, 0.5, 5.0]) * self.chance.random()
        if now_s < self.late_until_s:
            return b""
        data, self.waiting = self.waiting, b""
        return data


def late_bench(seed: int, traits: Traits = GRBL_11, *, begins_s: float = 0.5) -> Bench:
    bench = Bench(traits).connected()
    late = LateLink(bench.tap.port)
    late.chance = random.Random(seed)
    late.next_late_s = bench.mill.now_s + begins_s
    bench.tap = bench.driver._port = late
    return bench


@pytest.mark.parametrize("seed", range(24))
def test_nobody_is_blamed_for_our_absence_or_late_answers(seed: int) -> None:
    """A buffer that runs dry stops the mill, not the program."""
    chance = random.Random(seed)
    traits, segment_mm = chance.choice([GRBL_11, GRBLHAL, FLUIDNC]), chance.choice([0.02, 0.3, 3.0])
    lengths = chance.choice([[0.0], [0.0, 0.1, 0.3, 0.45], [0.1, 0.3, 0.45, 0.6, 2.0, 5.0, 20.0]])
    absences = [chance.choice(lengths) for _ in range(12)]
    bench = late_bench(seed, traits)
    turns = [b"G1X%.3fY%.3fF1500" % (segment_mm * (k % 40), segment_mm * (k // 40)) for k in range(240)]
    bench.start(numbered([b"G21G90G94G17", *turns, b"G4P3", b"M3S1000", *turns[:40], b"M2"]))
    for round_ in range(100_000):
        if bench.of(ProgramDone) or bench.of(Faulted):
            break
        bench.mill.advance(bench.mill.now_s + absences[round_ % len(absences)] * (round_ % 3 == 0))
        bench.events += bench.driver.poll(0.05)
    assert not bench.of(Faulted), bench.of(Faulted)
    assert bench.of(ProgramDone) and len(bench.mill.recording.cuts()) == len(turns) - 1 + 40


@pytest.mark.parametrize("absent_s", [0.0, 0.2, 0.45, 5.0])
def test_a_dead_link_is_found_in_a_bounded_number_of_looks(absent_s: float) -> None:
    bench = Bench().connected()
    bench.start(spiral(3000)[0])
    bench.pass_time(2.0)
    bench.mill._off = True
    looks = 0
    while not bench.of(Faulted):
        bench.mill.advance(bench.mill.now_s + absent_s)
        bench.events += bench.driver.poll(0.05)
        looks += 1
        assert looks < 40 * REPORT_SILENCE_S, "not found"
    assert looks > REPORT_SILENCE_S / LOOK_S / 2
    assert bench.of(Faulted)[0].cause is FaultCause.STALL
    assert any("no answer to '?' for 3 s" in event.words for event in bench.of(Notice))


def test_a_long_silence_keeps_the_lines_that_the_mill_has_cut() -> None:
    """Longer than our patience, then all of it: the mill stands at the end of a line, and that line counts."""
    bench = late_bench(1, begins_s=1e9)
    late = bench.tap
    lines, points = spiral(300)
    bench.start(lines, past_line=100)
    late.late_until_s = bench.mill.now_s + REPORT_SILENCE_S + 1.0
    late.next_late_s = 1e9
    assert bench.until(lambda: bench.of(Faulted), 2 * REPORT_SILENCE_S)
    assert bench.until(lambda: bench.state() is MillState.IDLE, 10.0)
    done = bench.last_whole(points)
    assert bench.driver.progress.executed_line - 6 == done


UNTRUE = ("no answer", "does not confirm", "not understood", "no banner", "restarted by itself")
TURNS = [b"G1X%.3fY%.3fF1500" % (k % 40, k // 40) for k in range(120)]


class OwnedLink(Tap):
    """Goes by running time, as a real port does."""

    def __init__(self, port: MemoryPort) -> None:
        super().__init__(port)
        self.running = make_running_clock(port.clock)

    def clock(self) -> float:
        return self.running()


class PausedBench(Bench):
    """Its process is stopped every now and then, for any time."""

    def __post_init__(self) -> None:
        self.link = OwnedLink
        super().__post_init__()
        self.chance = random.Random(0)

    def until_paused(self, done: object, rounds: int = 20_000) -> bool:
        for _ in range(rounds):
            if done():  # type: ignore[operator]
                return True
            if self.chance.random() < 0.1:
                self.mill.advance(self.mill.now_s + self.chance.choice([0.3, 2.0, 9.0, 40.0, 600.0]))
            self.events += self.driver.poll(0.05)
        return False

    def blames(self) -> list[object]:
        notices = [one for one in self.of(Notice) if any(word in one.words for word in UNTRUE)]
        return [*self.of(Faulted), *notices]


@pytest.mark.parametrize("seed", range(12))
def test_a_life_of_pauses_blames_nobody(seed: int) -> None:
    bench = PausedBench([GRBL_11, GRBLHAL, FLUIDNC][seed % 3])
    bench.chance = random.Random(seed)
    bench.driver.connect()
    assert bench.until_paused(lambda: bench.state() is MillState.IDLE), bench.driver.status
    for on, state in ((True, MillState.CHECK), (False, MillState.IDLE)):
        bench.driver.command(CheckMode(on))
        assert bench.until_paused(lambda state=state: bench.state() is state), bench.driver.status
    assert bench.until_paused(lambda: len(bench.of(CommandDone)) == 2)
    bench.start(numbered([b"G21G90G94G17", *TURNS, b"G4P3", b"M3S1000", b"G0X0", b"M2"]))
    bench.until_paused(lambda: bench.driver.progress.answered_line > bench.chance.randrange(100))
    bench.driver.hold()
    assert bench.until_paused(lambda: bench.state() is MillState.HELD or bench.of(ProgramDone))
    if not bench.of(ProgramDone):
        bench.driver.resume()
    assert bench.until_paused(lambda: bench.of(ProgramDone) or bench.of(Faulted))
    assert not bench.blames()
    assert len([cut for cut in bench.mill.recording.cuts() if cut.whole]) >= len(TURNS) - 1
    bench.start(numbered([b"G21G90G94G17", *TURNS, b"M2"]))
    bench.until_paused(lambda: bench.driver.progress.answered_line > 5)
    bench.driver.abort()
    assert bench.until_paused(lambda: bench.of(Stopped))
    assert not bench.blames() and bench.of(Stopped)[0].position_kept


@pytest.mark.parametrize("seed", range(4))
def test_a_dead_mill_is_found_by_a_process_that_is_paused(seed: int) -> None:
    bench = PausedBench()
    bench.chance = random.Random(seed)
    bench.driver.connect()
    assert bench.until_paused(lambda: bench.state() is MillState.IDLE)
    bench.start(numbered([b"G21G90G94G17", *TURNS * 20, b"M2"]))
    bench.until_paused(lambda: bench.driver.progress.answered_line > 10)
    bench.mill._off = True
    assert bench.until_paused(lambda: bench.of(Faulted), rounds=3000)
