"""Drip feed over a real pty through pyserial: DC3 is seen by us and not eaten by a tty, and it is obeyed."""

from __future__ import annotations

import os
import pty
import threading
import time
import tty

from machines.drip.driver import DripDriver
from machines.driver import MillState, ProgramDone, ProgramLine
from machines.port import open_port
from machines.profile import LinkSettings
from tests.waiting import PATIENCE_S

LINK = LinkSettings(driver="drip", baud=38400, flow="none")
PROGRAM = [ProgramLine(n, 0, b"N%dG01X%d.%03dY-4.5" % (n, n, n)) for n in range(1, 61)]


class PtyControl(threading.Thread):
    """A control on the far end of a pty: DC1, then DC3 after every 200 bytes, 60 ms of silence, DC1 again."""

    def __init__(self, fd: int) -> None:
        super().__init__(daemon=True)
        self.fd = fd
        self.received = bytearray()
        self.most_after_stop = 0
        self.stops = 0

    def run(self) -> None:
        os.write(self.fd, b"\x11")
        since = 0
        while self.received[1:].find(b"%") < 0:
            since += len(self._take())
            if since >= 200:
                self._stop()
                since = 0

    def _take(self) -> bytes:
        data = os.read(self.fd, 4096)
        self.received += data
        return data

    def _stop(self) -> None:
        os.write(self.fd, b"\x13")
        self.stops += 1
        time.sleep(0.06)
        os.set_blocking(self.fd, False)
        try:
            after = len(self._take())
        except BlockingIOError:
            after = 0
        os.set_blocking(self.fd, True)
        self.most_after_stop = max(self.most_after_stop, after)
        os.write(self.fd, b"\x11")


def test_every_byte_once_and_few_after_each_stop() -> None:
    """A busy computer may read DC3 late: only the order of magnitude is asked for (60 ms are 220 bytes of wire)."""
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    control = PtyControl(master)
    port = open_port(os.ttyname(slave), LINK)
    driver = DripDriver(port, LINK)
    driver.connect()
    try:
        driver.start(iter(PROGRAM))
        control.start()
        end_s = time.monotonic() + PATIENCE_S
        events = []
        while ProgramDone() not in events and time.monotonic() < end_s:
            events += driver.poll(0.5)
        control.join(PATIENCE_S)
        assert ProgramDone() in events
        assert driver.status.state is MillState.IDLE
        assert bytes(control.received) == b"%\r\n" + b"".join(line.text + b"\r\n" for line in PROGRAM) + b"%"
        assert control.stops >= 4
        assert control.most_after_stop <= 120
    finally:
        driver.close()
        os.close(master)
        os.close(slave)
