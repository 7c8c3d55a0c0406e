"""Between the last look at an order and its first byte on the wire nothing waits: no disk, no lock, no poll."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest

from machines.driver import CheckMode, Jog, Override, ProbeCorner, ProbeZ, Reset, SendBlock, SetZero, Unlock
from machines.gcode.program import ProgramReader
from machines.mill.orders import CARRY_OUT_S, GRANT_S, Caller, OrderRefusedError, Permit, Stop
from machines.runs import RunState
from machines.simulated.endpoints import MemoryPort
from tests.machines.shop import YES, YES_ALL, Shop

CORNER = ProbeCorner(depth_mm=10, plate_mm=1, wall_x_mm=1, wall_y_mm=1, cutter_radius_mm=1, margin_mm=8)
ORDERS: dict[str, Callable[[Shop], Callable[[Any], object]]] = {
    "start": lambda shop: lambda mill: mill.start(shop.id, YES),
    "recover": lambda shop: lambda mill: mill.recover(shop.id, YES_ALL),
    "resume": lambda _: lambda mill: mill.resume(),
    "jog": lambda _: lambda mill: mill.command(Jog((5.0, 0.0, 0.0), 600.0)),
    "probe": lambda _: lambda mill: mill.command(ProbeZ(depth_mm=10.0)),
    "corner": lambda _: lambda mill: mill.command(CORNER),
    "zero": lambda _: lambda mill: mill.command(SetZero("X")),
    "spindle": lambda _: lambda mill: mill.switch_spindle(9000.0),
    "block": lambda _: lambda mill: mill.command(SendBlock("G1 X1 F600")),
    "unlock": lambda _: lambda mill: mill.command(Unlock()),
    "check": lambda _: lambda mill: mill.command(CheckMode(True)),
    "override": lambda _: lambda mill: mill.command(Override("feed", 90)),
    "reset": lambda _: lambda mill: mill.command(Reset()),
}
ASK_FIRST = ("start", "recover", "probe", "corner", "override")
QUESTIONS = (b"$I", b"$$", b"$#", b"$G", b"")
HANG_S = 15.0
AFTERWARDS = 99  # not at a write: the owner is away when the order has been taken


def acts(data: bytes) -> bool:
    """More than questions and stops."""
    return any(line not in QUESTIONS for line in data.translate(None, b"?!").split(b"\n"))


class Trace:
    """What happens to one order, in its sequence: "look", "disk", "write"; and when its first byte left."""

    def __init__(self, shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
        self.events: list[str] = []
        self.first_s: float | None = None
        self.hang_at = -1
        self._shop, self._writes = shop, 0
        require, write, lines = Permit.require, MemoryPort.write, ProgramReader.lines

        def note_look(permit: Permit) -> None:
            require(permit)
            self.events.append("look")

        def note_write(port: MemoryPort, data: bytes) -> None:
            if acts(data):
                self.events.append("write")
                self.first_s = shop.bench.sim.now_s if self.first_s is None else self.first_s
            write(port, data)

        def read_lines(reader: ProgramReader, from_line: int = 1) -> Iterator[object]:
            for line in lines(reader, from_line):
                self.use_disk()
                yield line

        monkeypatch.setattr(Permit, "require", note_look)
        monkeypatch.setattr(MemoryPort, "write", note_write)
        monkeypatch.setattr(ProgramReader, "lines", read_lines)
        shop.disk.before_write = self.use_disk

    def use_disk(self) -> None:
        self.events.append("disk")
        if self._writes == self.hang_at:
            self._shop.bench.sim.advance(self._shop.bench.sim.now_s + HANG_S)
        self._writes += 1

    @property
    def is_look_last(self) -> bool:
        """The driver has looked itself, after the grant was redeemed, and nothing came between that and its write."""
        before = self.events[: self.events.index("write")]
        return before.count("look") > 1 and before[-1] == "look"


def make_ready(shop: Shop, order: str) -> None:
    """The mill as this order needs it; another run has ended before, whose touch-off is still to be noted."""
    shop.mill.orders._clock = lambda: shop.bench.sim.now_s
    if order == "start":
        shop.started().until(RunState.FINISHED)
        shop.id = shop.mill.park(shop.facts, shop.path, "next").id
    elif order == "resume":
        shop.started().held()
    elif order == "recover":
        shop.started().aborted()
    shop.pass_s(1.0)


def give(shop: Shop, order: str) -> None:
    caller = Caller(grant=shop.mill.orders.issue_grant().word)
    shop.mill.carry_out(order, ORDERS[order](shop), caller)


@pytest.mark.parametrize("order", ORDERS)
def test_the_last_look_is_followed_by_the_first_byte(shop: Shop, order: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make_ready(shop, order)
    trace = Trace(shop, monkeypatch)
    give(shop, order)
    shop.bench.until(lambda: trace.first_s is not None)
    assert trace.is_look_last, trace.events


@pytest.mark.parametrize("hang_at", [*range(8), AFTERWARDS])
@pytest.mark.parametrize("order", ORDERS)
def test_wherever_the_disk_hangs_an_order_comes_in_time_or_never(
    shop: Shop, order: str, hang_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_ready(shop, order)
    state, trace, pressed_s = shop.state, Trace(shop, monkeypatch), shop.bench.sim.now_s
    trace.hang_at = hang_at
    refused = False
    try:
        give(shop, order)
    except OrderRefusedError:
        refused = True
    if hang_at == AFTERWARDS:
        shop.bench.sim.advance(shop.bench.sim.now_s + HANG_S)
    shop.pass_s(3.0)
    assert not refused or trace.first_s is None
    assert not refused or shop.state is state
    limit_s = CARRY_OUT_S if order in ASK_FIRST else GRANT_S
    assert trace.first_s is None or trace.first_s <= pressed_s + limit_s


@pytest.mark.parametrize("order", ["start", "resume", "jog", "block", "zero"])
def test_a_stop_in_the_moment_of_the_write_is_followed_by_its_byte(
    shop: Shop, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was counted after the last look, and its byte left before the order's: one more follows them."""
    make_ready(shop, order)
    write, on_wire = MemoryPort.write, []

    def stop_first(port: MemoryPort, data: bytes) -> None:
        if not on_wire and acts(data):
            shop.mill.orders.count_stop()
            write(port, b"!")
            on_wire.append(b"!")
        if on_wire:
            on_wire.append(data)
        write(port, data)

    monkeypatch.setattr(MemoryPort, "write", stop_first)
    shop.disk.before_write = lambda: len(on_wire) != 2 or pytest.fail("a disk came before the stop's byte")
    with suppress(OrderRefusedError):
        give(shop, order)
    assert b"!" in on_wire[2], on_wire
    shop.disk.before_write = lambda: None
    shop.mill.carry_out_stop(Stop.HOLD, Caller())
    shop.pass_s(3.0)
    before = shop.cuts
    shop.pass_s(5.0)
    assert shop.cuts == before
