"""Links that only take blocks: an order is looked at when its first bytes are read and only their write is left."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from machines.drip.driver import DripDriver
from machines.driver import Faulted, MillState, Override, ProgramDone, ProgramLine
from machines.errors import NotAllowedError
from machines.profile import LinkSettings
from machines.roland.serial_driver import RolandSerialDriver
from machines.roland.usb_device import RollingmillDevice
from machines.roland.usb_driver import RolandUsbDriver
from phrases.phrase import Phrase
from tests.machines.drip.simulated_control import SimulatedControl
from tests.machines.roland.simulated_device import SimulatedMdx40a, open_simulated
from tests.machines.roland.simulated_serial import SimulatedSerialMill

HEAD = b"%|O00000001|G90|G21|G54|S12000|M03|G00 Z5.0|G00 X0.0 Y0.0|G01 Z-1.0 F300.0".split(b"|")
TEXTS = (*HEAD, *(b"G01 X%d.0 Y0.0 Z-1.0 F1200.0" % x for x in range(1, 40)), b"G00 Z5.0", b"M05", b"M02", b"%")


class Bench:
    """A driver of one kind; `events`: "read", "look" and "write", in their sequence."""

    def __init__(self, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
        self.events: list[str] = []
        self.too_late = False
        self.driver, owner, name = getattr(self, f"_{kind}")()
        write = getattr(owner, name)

        def note(link: object, data: bytes) -> None:
            self.events.append("write")
            write(link, data)

        monkeypatch.setattr(owner, name, note)
        self.driver.connect()
        for _ in range(10):
            self.driver.poll(0.2)
        self.events.clear()

    def _usb(self) -> tuple[Any, type, str]:
        device = open_simulated(SimulatedMdx40a())
        return RolandUsbDriver(device, dialect="roland-nc"), RollingmillDevice, "write_block"

    def _serial(self) -> tuple[Any, type, str]:
        mill = SimulatedSerialMill(buffer_bytes=2048, command_s=0.1)
        link = LinkSettings(driver="roland-serial", baud=9600, flow="rtscts", rx_bytes=2048)
        return RolandSerialDriver(mill, link), SimulatedSerialMill, "write"

    def _drip(self) -> tuple[Any, type, str]:
        link = LinkSettings(driver="drip", baud=4800, bytesize=7, parity="E", stopbits=2, flow="none", rx_bytes=512)
        control = SimulatedControl(bytes_per_s=link.wire_bytes_per_s, ready_at_s=0.0)
        return DripDriver(control, link), SimulatedControl, "write"

    def lines(self) -> Iterator[ProgramLine]:
        for number, text in enumerate(TEXTS, start=1):
            self.events.append("read")
            yield ProgramLine(number, 20 * number, text)

    def require(self) -> None:
        if self.too_late:
            raise NotAllowedError(Phrase("too late"))
        self.events.append("look")

    def until_written(self, count: int) -> None:
        for _ in range(200):
            if self.events.count("write") >= count:
                return
            self.driver.poll(0.05)
        raise AssertionError(self.events)


@pytest.fixture(params=["usb", "serial", "drip"])
def bench(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(request.param, monkeypatch)


def test_the_last_look_at_a_start_is_followed_by_its_first_write(bench: Bench) -> None:
    bench.driver.start(bench.lines(), bench.require)
    first = bench.events.index("write")
    assert bench.events[first - 1 : first + 2] == ["look", "write", "look"], bench.events
    assert "read" in bench.events[: first - 1]


def test_a_start_that_is_too_late_has_sent_nothing_and_can_be_given_again(bench: Bench) -> None:
    bench.too_late = True
    with pytest.raises(NotAllowedError, match="too late"):
        bench.driver.start(bench.lines(), bench.require)
    bench.driver.poll(1.0)
    assert "write" not in bench.events and bench.driver.status.state is MillState.IDLE
    bench.too_late = False
    bench.driver.start(bench.lines(), bench.require)
    bench.until_written(3)


def test_a_resume_that_is_too_late_has_sent_nothing_and_loses_no_block(bench: Bench) -> None:
    bench.driver.start(bench.lines(), bench.require)
    bench.driver.hold()
    for _ in range(40):
        bench.driver.poll(0.05)
    written, bench.too_late = bench.events.count("write"), True
    with pytest.raises(NotAllowedError, match="too late"):
        bench.driver.resume(bench.require)
    bench.driver.poll(1.0)
    assert bench.events.count("write") == written
    assert bench.driver.status.state in (MillState.HELD, MillState.HOLDING)
    bench.too_late = False
    bench.driver.resume(bench.require)
    assert bench.events[-2:] == ["write", "look"] and bench.events[-3] == "look", bench.events
    bench.until_written(written + 2)
    events: list[object] = []
    while not events:
        events = [event for event in bench.driver.poll(1.0) if isinstance(event, ProgramDone | Faulted)]
    assert events == [ProgramDone()]


def test_an_override_that_is_too_late_is_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench("usb", monkeypatch)
    bench.too_late = True
    with pytest.raises(NotAllowedError, match="too late"):
        bench.driver.command(Override("feed", 120), bench.require)
    assert bench.driver.status.overrides == (100, 100, 100)
