"""Programs for mills outside the GRBL family, end to end: pre-flight, reader, driver, simulated machine, Mill."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from machines.drip.driver import DripDriver
from machines.driver import Driver, MillState
from machines.errors import PortLostError
from machines.gcode.program import ProgramReader
from machines.journal.journal import Journal
from machines.mill.mill import Mill
from machines.preflight.preflight import Preflight
from machines.profile import LinkSettings, MachineProfile, load_profile
from machines.recovery.plan_model import Reentry
from machines.roland.serial_driver import RolandSerialDriver
from machines.roland.usb_driver import RolandUsbDriver
from machines.runs import START_CHECKS, Confirmation, RunState
from service.milling.preflight import run_preflight
from tests.machines.disks import InlineSyncer
from tests.machines.drip.simulated_control import SimulatedControl
from tests.machines.roland.simulated_device import SimulatedMdx40a, open_simulated
from tests.machines.roland.simulated_serial import SimulatedSerialMill

YES = Confirmation("ann", START_CHECKS)
MDX = load_profile("roland-mdx-40a", ())
EGX = replace(MDX, dialect="rml-1", link=LinkSettings("roland-serial", 9600, flow="rtscts", rx_bytes=128))
OSP = load_profile("okuma-osp", ())
ZIGZAG = [(row % 2 * 20.0, 0.5 * row, -1.0 - 0.01 * row) for row in range(1, 40)]


def rml() -> bytes:
    moves = "".join(f"Z{100 * x:.0f},{100 * y:.0f},{100 * z:.0f};\r\n" for x, y, z in ZIGZAG)
    head = ";;^DF;\r\n!MC0;V50.0;\r\n^PR;Z0,0,10500;^PA;\r\n!RC15;!MC1;\r\nZ0,0,500;\r\nV20.0;Z0,0,-100;\r\n"
    return f"{head}{moves}!MC0;\r\n^PR;Z0,0,10500;^PA;\r\n^DF;\r\n\x1a".encode()


def nc() -> bytes:
    moves = "".join(f"G01 X{x:.1f} Y{y:.3f} Z{z:.3f}\r\n" for x, y, z in ZIGZAG)
    head = "%\r\nO00000001\r\nG90 G21 G54\r\nS12000 M03\r\nG00 Z5.0\r\nG00 X0.0 Y0.0\r\nG01 Z-1.0 F1200.0\r\n"
    return f"(a part)\r\n{head}{moves}G00 Z5.0\r\nM05\r\nM02\r\n%\r\n".replace("(a part)\r\n", "").encode()


def osp() -> bytes:
    moves = "".join(f"N{n} G1 X{x:.1f} Y{y:.3f} Z{z:.3f}\r\n" for n, (x, y, z) in enumerate(ZIGZAG, 10))
    head = "%\r\nOLENS (the lens)\r\nN1 G15 H1\r\nN2 G90 G17\r\nN3 G56 H1\r\nN4 S5000 M3\r\nN5 G0 Z10.\r\nX0. Y0.\r\n"
    return f"{head}N6 G1 Z-1. F1200.\r\n{moves}N90 G0 Z10.\r\nN91 M5\r\nN92 M2\r\n%\r\n".encode()


@dataclass
class Link:
    """One kind of link: its machine, and what of the program the machine has executed."""

    profile: MachineProfile
    text: bytes
    machine: Any
    driver: Callable[[Any], Driver]
    executed: Callable[[Any], list[bytes]]
    hold_ends_in: RunState

    def run_dry(self) -> None:
        if isinstance(self.machine, SimulatedMdx40a):
            self.machine.wait(600.0)
        else:
            self.machine.run_dry()


def _usb(mill: SimulatedMdx40a, dialect: str) -> Driver:
    if mill.unplugged:
        raise PortLostError("usb:mdx-40a", "not there")
    return RolandUsbDriver(open_simulated(mill), dialect=dialect)


def _reached(port: Any) -> Any:
    if port.unplugged:
        raise PortLostError(port.url, "not there")
    return port


def _commands(mill: SimulatedSerialMill) -> list[bytes]:
    return [command for command in mill.executed if command]


LINKS: dict[str, Callable[[], Link]] = {
    "rml over rs-232": lambda: Link(
        EGX, rml(), SimulatedSerialMill(buffer_bytes=128, margin_bytes=32, command_s=0.3),
        lambda port: RolandSerialDriver(_reached(port), EGX.link, dialect="rml-1", planner_blocks=8),
        _commands, RunState.HOLDING,
    ),
    "rml over usb": lambda: Link(
        replace(MDX, dialect="rml-1"), rml(), SimulatedMdx40a(), lambda mill: _usb(mill, "rml-1"),
        lambda mill: mill.begun, RunState.HELD,
    ),
    "nc over usb": lambda: Link(
        MDX, nc(), SimulatedMdx40a(), lambda mill: _usb(mill, "roland-nc"), lambda mill: mill.begun, RunState.HELD
    ),
    "okuma, drip": lambda: Link(
        OSP, osp(), SimulatedControl(bytes_per_s=872.0, buffer_bytes=512, line_s=0.3),
        lambda port: DripDriver(_reached(port), OSP.link), lambda control: control.executed, RunState.HOLDING,
    ),
}  # fmt: skip


class Shop:
    def __init__(self, folder: Path, link: Link) -> None:
        self.link, self.machine = link, link.machine
        path = folder / "part"
        path.write_bytes(link.text)
        self.facts: Preflight = run_preflight(path, link.profile, cache=folder.parent / "preflight")
        self.lines = list(ProgramReader(path, self.facts.index).lines())
        self.mill = Mill(
            name="far",
            reentry=Reentry(safe_z_mm=5.0),
            connect=lambda: link.driver(self.machine),
            folder=folder / "mill",
            clock=self.machine.clock,
            wall_clock=lambda: 1.8e9 + self.machine.now_s,
            open_journal=lambda runs: Journal(runs, syncer=InlineSyncer(self.machine.clock)),
            pause=self._pause,
        )
        self.until(lambda: self.mill.status.state is MillState.IDLE)
        self.id = self.mill.park(self.facts, path, "part").id

    def _pause(self, seconds: float) -> None:
        self.machine.now_s += seconds

    def until(self, done: Callable[[], bool], patience_s: float = 3000.0) -> None:
        end_s = self.machine.now_s + patience_s
        while not done():
            assert self.machine.now_s < end_s, (self.mill.snapshot.status, self.mill.snapshot.events[-5:])
            self.mill.step(0.2)

    def until_run(self, *states: RunState) -> None:
        self.until(lambda: self.state in states)

    @property
    def state(self) -> RunState:
        return self.mill.run(self.id).state

    @property
    def words(self) -> str:
        return " / ".join(entry.words for entry in self.mill.snapshot.events)

    def started(self, lines: int = 12) -> Shop:
        self.mill.start(self.id, YES)
        self.until(lambda: len(self.link.executed(self.machine)) >= lines)
        return self

    def require_all_executed_once(self) -> None:
        """What the machine did is the program, in order: command by command, or block by block."""
        self.link.run_dry()
        done = self.link.executed(self.machine)
        text = [line.text for line in self.lines]
        if isinstance(self.machine, SimulatedSerialMill):
            text = [part.strip() for line in text for part in line.split(b";") if part.strip()]
        elif isinstance(self.machine, SimulatedControl):
            text = [line for line in text if line != b"%"]
        assert done == text


@pytest.fixture(params=LINKS)
def shop(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Shop]:
    made = Shop(tmp_path, LINKS[request.param]())
    yield made
    made.mill.close(detach=True)


@pytest.mark.thorough
def test_preflight_knows_the_part_and_the_reader_gives_every_block(shop: Shop) -> None:
    facts = shop.facts
    assert facts.dialect == shop.link.profile.dialect
    assert facts.bounds_mm is not None or facts.bounds_by_frame
    box = facts.bounds_mm or next(iter(facts.bounds_by_frame.values()))
    assert box.span_mm(0) == pytest.approx(20.0) and box.span_mm(1) == pytest.approx(19.5)
    assert box.least_mm[2] == pytest.approx(-1.39)
    assert facts.feeds_mm_per_min is not None and 1200.0 in facts.feeds_mm_per_min
    assert facts.ends and facts.blocks == len(shop.lines)
    assert facts.time_s > 60 * 39 * 20 / 1200
    assert Preflight.from_json(facts.to_json()) == facts


@pytest.mark.thorough
def test_a_run_to_its_end(shop: Shop) -> None:
    shop.started().until_run(RunState.FINISHED)
    shop.require_all_executed_once()
    assert shop.mill.run(shop.id).share == 1.0


@pytest.mark.thorough
def test_hold_and_resume_lose_and_double_nothing(shop: Shop) -> None:
    shop.started()
    shop.mill.hold()
    shop.until_run(shop.link.hold_ends_in)
    held = shop.mill.snapshot.progress.sent_line
    for _ in range(200):
        shop.mill.step(0.5)
    assert shop.mill.snapshot.progress.sent_line == held < shop.lines[-1].number
    assert shop.state is shop.link.hold_ends_in
    shop.mill.resume()
    shop.until_run(RunState.FINISHED)
    shop.require_all_executed_once()


def test_abort_ends_the_run_and_says_what_the_machine_may_still_do(shop: Shop) -> None:
    shop.started()
    shop.mill.abort()
    shop.until_run(RunState.ABORTED)
    shop.link.run_dry()
    assert len(shop.link.executed(shop.machine)) < len(shop.lines)
    view = shop.mill.run(shop.id)
    assert view.executed_line < shop.lines[-1].number
    assert shop.mill.status.state is MillState.IDLE
    if shop.link.hold_ends_in is RunState.HOLDING:
        assert "may still execute" in shop.words


@pytest.mark.thorough
def test_a_lost_link_interrupts_and_recovery_by_hand_is_said_in_words(shop: Shop) -> None:
    shop.started()
    shop.machine.unplugged = True
    shop.until_run(RunState.INTERRUPTED)
    assert "port lost" in shop.mill.run(shop.id).words
    executed = shop.mill.run(shop.id).executed_line
    shop.machine.unplugged = False
    shop.until(lambda: shop.mill.status.state is MillState.IDLE)
    for _ in range(20):
        shop.mill.step(0.5)
    assert shop.state is RunState.INTERRUPTED, "nothing goes on by itself"
    plan = shop.mill.plan_recovery(shop.id)
    assert not plan.ready and "program with the remaining lines" in " ".join(plan.refusals)
    assert executed <= len(shop.link.executed(shop.machine))


@pytest.mark.thorough
def test_a_program_changed_on_disk_stops_before_its_first_changed_byte(shop: Shop) -> None:
    path = Path(shop.mill.run(shop.id).path)
    path.write_bytes(path.read_bytes().replace(b"0.5", b"0.6").replace(b",50,", b",60,"))
    shop.mill.start(shop.id, YES)
    shop.until_run(RunState.INTERRUPTED)
    shop.link.run_dry()
    assert not shop.link.executed(shop.machine)
    assert "run pre-flight again" in shop.mill.run(shop.id).words
