"""A Roland over a real pty through pyserial and `open_driver`: a busy mill loses nothing, and a hold holds.

A pty has no CTS and tells TIOCOUTQ as 0 (what is written lies in the far end's queue at once), so the mill here is busy
by not reading, and what it has not read stands for what a UART would still hold.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import os
import pty
import termios
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace

import pytest

from machines.driver import Driver, Event, FaultCause, Faulted, MillState, ProgramDone, ProgramLine
from machines.open_driver import open_driver
from machines.port import SerialPort
from machines.profile import LinkSettings, load_profile
from tests.waiting import PATIENCE_S

PROFILE = replace(
    load_profile("roland-mdx-40a", ()),
    dialect="rml-1",
    link=LinkSettings(driver="roland-serial", baud=38400, flow="rtscts", rx_bytes=512),
)
PROGRAM = [ProgramLine(n, 0, b"V10.5;Z%d,%d,-50;" % (n, 2 * n)) for n in range(1, 121)]
SENT = b"".join(line.text + b"\n" for line in PROGRAM)


class PtyMill(threading.Thread):
    """Reads when it likes: after every `busy_every` bytes it takes nothing for `busy_s`."""

    def __init__(self, fd: int, *, busy_every: int = 700, busy_s: float = 0.15) -> None:
        super().__init__(daemon=True)
        self.fd, self.busy_every, self.busy_s = fd, busy_every, busy_s
        self.received = bytearray()
        self.most_waiting = 0

    @property
    def waiting(self) -> int:
        if self.fd < 0:
            return 0
        count = array.array("i", [0])
        fcntl.ioctl(self.fd, termios.FIONREAD, count)
        return count[0]

    def run(self) -> None:
        since = 0
        while len(self.received) < len(SENT):
            try:
                data = os.read(self.fd, 64)
            except OSError:
                return
            self.received += data
            since += len(data)
            if since >= self.busy_every:
                since = 0
                time.sleep(self.busy_s)
                self.most_waiting = max(self.most_waiting, self.waiting)


@pytest.fixture
def linked(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Driver, PtyMill, int]]:
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    mill = PtyMill(master)
    monkeypatch.setattr(SerialPort, "unsent_bytes", lambda port: mill.waiting)
    driver = open_driver(PROFILE, os.ttyname(slave))
    driver.connect()
    yield driver, mill, slave
    driver.close()
    for fd in (master, slave):
        with contextlib.suppress(OSError):
            os.close(fd)


def until_done(driver: Driver) -> list[Event]:
    events: list[Event] = []
    end_s = time.monotonic() + PATIENCE_S
    while not any(isinstance(event, ProgramDone | Faulted) for event in events):
        assert time.monotonic() < end_s, driver.status
        events += driver.poll(0.2)
    return events


def test_a_busy_mill_gets_every_byte_once_and_little_waits_for_it(linked: tuple[Driver, PtyMill, int]) -> None:
    driver, mill, _ = linked
    driver.start(iter(PROGRAM))
    mill.start()
    assert ProgramDone() in until_done(driver)
    mill.join(PATIENCE_S)
    assert bytes(mill.received) == SENT
    assert 0 < mill.most_waiting <= 128
    assert driver.progress.answered_line == len(PROGRAM)
    assert driver.progress.executed_line < len(PROGRAM)  # 512 bytes may still wait in the mill


def test_hold_stops_within_the_little_that_waits_and_resume_goes_on(linked: tuple[Driver, PtyMill, int]) -> None:
    driver, mill, _ = linked
    driver.start(iter(PROGRAM))
    mill.start()
    while len(mill.received) < 1000:
        driver.poll(0.02)
    driver.hold()
    before = len(mill.received)
    end_s = time.monotonic() + 0.6
    while time.monotonic() < end_s:
        driver.poll(0.05)
    assert driver.status.state is MillState.HOLDING
    assert len(mill.received) - before <= 192
    driver.resume()
    assert ProgramDone() in until_done(driver)
    mill.join(PATIENCE_S)
    assert bytes(mill.received) == SENT


def test_a_cable_that_is_pulled_is_a_lost_port(linked: tuple[Driver, PtyMill, int]) -> None:
    driver, mill, slave = linked
    driver.start(iter(PROGRAM))
    driver.poll(0.05)
    os.close(slave)
    os.close(mill.fd)
    mill.fd = -1
    faults = [event for event in until_done(driver) if isinstance(event, Faulted)]
    assert faults[0].cause is FaultCause.PORT_LOST
    assert driver.status.state is MillState.DISCONNECTED
