"""A healthy link is never blamed, however late we or its answers are; a dead one is found in so many looks."""

from __future__ import annotations

import random

import pytest

from machines.clock import LOOK_S
from machines.driver import FaultCause, Faulted, MillState, Notice, ProgramDone
from machines.grbl.timeouts import REPORT_SILENCE_S
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
