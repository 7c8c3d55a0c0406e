"""Time in which this process did not run counts against nobody, and for nobody who acts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from machines.clock import LOOK_S, RunningTime, Timeout, make_running_clock, suspend_aware_clock_s
from machines.journal.disk import ThreadSyncer
from machines.mill.orders import OrderGate
from service.server.worker.lease import Lease
from tests.machines.disks import Clock
from tests.waiting import until

PAUSES_S = st.sampled_from([0.0, 0.3, 3.0, 40.0, 3600.0, 1e6])


@given(st.lists(st.tuples(st.floats(0.0, LOOK_S), PAUSES_S), max_size=60), st.floats(0.6, 60.0))
def test_a_pause_is_worth_one_look(turns: list[tuple[float, float]], limit_s: float) -> None:
    clock = Clock()
    timeout, running = Timeout(limit_s, clock=clock), RunningTime()
    ran_s, pauses = 0.0, 0
    for turn_s, pause_s in turns:
        clock.now_s += turn_s + pause_s
        ran_s, pauses = ran_s + turn_s, pauses + (pause_s > 0.0)
        running.look(clock.now_s)
        over = timeout.is_over
        assert min(ran_s, LOOK_S) - 1e-6 <= running.spent_s <= ran_s + LOOK_S * pauses + 1e-6
        assert not over or ran_s + LOOK_S * pauses >= limit_s - 1e-6


@given(PAUSES_S, st.floats(0.01, 100.0))
def test_nobody_is_blamed_at_the_first_look_after_a_pause(pause_s: float, limit_s: float) -> None:
    clock = Clock()
    timeout = Timeout(limit_s, clock=clock, most_s=limit_s)
    clock.now_s += pause_s
    assert not timeout.is_over
    timeout.restart()
    clock.now_s += pause_s
    assert not timeout.is_over


@given(st.floats(0.6, 60.0))
def test_who_gives_no_sign_is_found(limit_s: float) -> None:
    clock = Clock()
    timeout, looks = Timeout(limit_s, clock=clock), 0
    while not timeout.is_over:
        clock.now_s += 0.05
        looks += 1
    assert limit_s / 0.05 - 2 <= looks <= limit_s / 0.05 + 2


def test_a_running_clock_goes_on_and_never_jumps() -> None:
    clock = Clock()
    running = make_running_clock(clock)
    seen = [running()]
    for pause_s in (0.1, 40.0, -5.0, 0.2, 1e9):
        clock.now_s += pause_s
        seen.append(running())
    steps = [b - a for a, b in pairwise(seen)]
    assert all(0.0 <= step <= 1.0 for step in steps)


def test_what_lets_us_act_ages_in_real_time() -> None:
    """A paused worker must not believe that its lease holds; a paused agent must not carry out an old order."""
    clocks = {one.name: one.default for one in fields(Lease)}
    assert clocks["monotonic"] is suspend_aware_clock_s
    assert OrderGate()._clock is suspend_aware_clock_s


class GatedFile:
    """Its sync ends when it is let."""

    def __init__(self, gate: Iterator[object]) -> None:
        self._gate = gate

    def write(self, data: bytes) -> None: ...

    def sync(self) -> None:
        next(self._gate)

    def close(self) -> None: ...


def test_a_paused_process_does_not_blame_its_disk() -> None:
    clock = Clock()
    syncer = ThreadSyncer(every_s=3600.0, clock=clock)  # nothing is synced by itself
    syncer.take(GatedFile(iter([])), lambda: None)
    for _ in range(3):
        clock.now_s += 0.05
        assert syncer.failure == ""
    for pause_s in (40.0, 3600.0):
        clock.now_s += pause_s
        assert syncer.failure == ""
    for _ in range(700):
        clock.now_s += 0.05
    assert syncer.failure == ""  # nobody looked meanwhile
    for _ in range(700):
        clock.now_s += 0.05
        _ = syncer.failure
    assert "has not finished an fsync for" in syncer.failure  # a disk that hangs is found all the same


def test_who_waits_for_the_disk_does_not_blame_it_for_a_pause() -> None:
    """The clock jumps by 40 s while `sync` waits; the disk is done a few looks later."""
    looks = 0

    def now_s() -> float:
        nonlocal looks
        looks += 1
        return 0.01 * looks + (40.0 if looks > 3 else 0.0)

    def disk() -> Iterator[object]:
        until(lambda: looks > 6, what="a wait of several looks")
        yield None

    syncer = ThreadSyncer(every_s=0.001, clock=now_s)
    syncer.take(GatedFile(disk()), lambda: None)
    syncer.sync()
    assert syncer.failure == ""


CHILD = """
import sys
import serial
from machines.journal.disk import ThreadSyncer
from machines.port import SerialPort
syncer = ThreadSyncer(every_s=3600.0, timeout_s=3.0)
class File:
    def write(self, data): pass
    def sync(self): pass
    def close(self): pass
port = SerialPort("loop://", serial.serial_for_url("loop://"), None)
begun_s = port.clock()
syncer.take(File(), lambda: None)
print("waits", flush=True)
sys.stdin.readline()
print([syncer.failure for _ in range(5)], port.clock() - begun_s < 2.0, flush=True)
"""


def test_a_process_that_was_really_stopped_blames_neither_disk_nor_mill() -> None:
    """SIGSTOP for longer than a disk may take. Five looks count 1.25 s at most, so a busy computer changes nothing."""
    root = Path(__file__).parents[2]
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", CHILD], cwd=root, stdin=pipe, stdout=pipe, text=True) as child:
        assert child.stdin is not None and child.stdout is not None
        assert child.stdout.readline() == "waits\n"
        os.kill(child.pid, signal.SIGSTOP)
        stopped_s = time.monotonic()
        until(lambda: time.monotonic() > stopped_s + 3.5)
        os.kill(child.pid, signal.SIGCONT)
        child.stdin.write("\n")
        child.stdin.close()
        assert child.stdout.readline() == f"{[''] * 5} True\n"
