"""A process that is paused, at any moment, for any time, blames neither mill nor link; the mill just runs dry."""

from __future__ import annotations

import random

import pytest

from machines.clock import make_running_clock
from machines.driver import CheckMode, CommandDone, Faulted, MillState, Notice, ProgramDone, Stopped
from machines.simulated.endpoints import MemoryPort
from machines.simulated.traits import FLUIDNC, GRBL_11, GRBLHAL
from tests.machines.grbl.bench import Bench, Tap, numbered

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
