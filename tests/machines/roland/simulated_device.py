"""A simulated MDX-40A at the level of USB transfers, in simulated time, with the traits that its users found.

Vendor control transfers and bulk-out as rollingmill sends them. It ignores bytes outside the job bracket, counts bytes
when its small block buffer takes them (before they are cut), stops counting with the error bit up on a wrong command
set or a word its NC dialect does not know, hangs on writes of 32 KB, runs everything flat at Z0 as rapids once Z went
above machine zero, and stops at once when the cover opens in a cut. An error stays.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, field
from math import inf

import pytest

from machines.driver import Triple
from machines.roland.usb_device import RollingmillDevice
from tests.machines.roland.simulated_blocks import BlockInterpreter, Cut, SimulatedAxes

ERROR_PROGRAM, ERROR_COVER = 0x0F01, 0x0109  # the first is ours: what a refused block reports is not known
_CONSTANT = 0x0000_081C


class SimulatedUsbError(Exception):
    """What libusb would raise: timeout, no device."""


@dataclass(slots=True, kw_only=True)
class SimulatedMdx40a:
    """command_set : 0 RML-1, 1 NC code, 2 by the first byte
    blocks      : program lines the mill holds beyond the one it executes
    transfer_s  : time of one USB transfer
    gap_s       : it stands (and says idle) this long between moves
    """

    command_set: int = 2
    blocks: int = 4
    transfer_s: float = 0.0005
    gap_s: float = 0.0
    origins_mm: dict[int, Triple] = field(default_factory=lambda: {1: (50.0, 50.0, -40.0), 3: (50.0, 50.0, -40.0)})

    now_s: float = 0.0
    cuts: list[Cut] = field(default_factory=list)
    begun: list[bytes] = field(default_factory=list)  # lines whose execution has begun
    ignored_bytes: int = 0
    counter: int = 0
    door_open: bool = False
    paused: bool = False
    unplugged: bool = False
    released: int = 0  # times the host has let go of the interface
    error: int = 0
    sets: list[tuple[int, bytes]] = field(default_factory=list)
    bracket: bool = False

    axes: SimulatedAxes = field(default_factory=SimulatedAxes)
    _program: BlockInterpreter = field(init=False)
    _input: bytearray = field(default_factory=bytearray)
    _held: deque[bytes] = field(default_factory=deque)
    _hung: bool = False
    _response: bytes = b""
    _ready_s: float = 0.0

    def __post_init__(self) -> None:
        self._program = BlockInterpreter(self.axes, self.origins_mm)

    # Time.

    def clock(self) -> float:
        return self.now_s

    def wait(self, timeout_s: float) -> None:
        self._advance(self.now_s + timeout_s)

    @property
    def idle(self) -> bool:
        """Nothing moves and nothing is left to do."""
        return self.axes.move is None and not self._held and not self._program.parts

    def press_view(self) -> None:
        """Pause; pressed for 3 s when paused: go on."""
        self._advance(self.now_s)
        (self.axes.resume if self.paused else self.axes.pause)(self.now_s)
        self.paused = not self.paused

    def open_door(self) -> None:
        self._advance(self.now_s)
        self.door_open = True
        if self.axes.move is not None or self._program.spindle_on or self._held:
            self._stop_by_error(ERROR_COVER)

    # Transfers.

    def vend_set(self, wValue: int, data: bytes = b"") -> None:
        self._transfer()
        self.sets.append((wValue, data))
        if wValue == 0x1109:
            self.bracket = data == b"\x00"
            self._program.language = "" if self.bracket else self._program.language
        elif wValue == 0x03F3:
            self._input.clear()
            self._stop()
        elif wValue == 0x3107:
            self.command_set = data[1]
        else:
            self._response = self._answer(wValue)

    def vend_get(self, wValue: int, length: int) -> bytes:
        self._transfer()
        return self._read_register(wValue)[:length]

    def bulk_write(self, data: bytes) -> int:
        self._transfer()
        if len(data) >= 0x8000 or self._hung:
            self._hung = True
            raise SimulatedUsbError("bulk write timed out")
        if not self.bracket:
            self.ignored_bytes += len(data)
            return len(data)
        self._input += data
        self._work()
        return len(data)

    def _transfer(self) -> None:
        if self.unplugged:
            raise SimulatedUsbError("no such device (it may have been disconnected)")
        self._advance(self.now_s + self.transfer_s)

    # Registers.

    def _read_register(self, number: int) -> bytes:
        match number:
            case 0x0001:
                word = 0x0082_0800 | 0x0010_0000 * bool(self.error) | 0x4 * (self.axes.move is not None)
                return struct.pack("<I", word | min(len(self._response), 255) << 24)
            case 0x0002:
                return b"\0\0\x12\x34"
            case 0x0003:
                return self._response
            case 0x0100:
                return self._encode_state()
            case 0x0200:
                return struct.pack(">I", self.counter & 0xFFFFFFFF)
            case _:
                raise SimulatedUsbError(f"stalled: register 0x{number:04x}")

    def _encode_state(self) -> bytes:
        flags = _CONSTANT | (0x4000_0000 if self.paused else 0x0080_0000)
        flags |= 0x1000_0000 * self.door_open | 0x0800_0000 * self._program.spindle_on | 0x1000 * bool(self.error)
        runs = self.axes.move is not None and not self.paused
        flags |= 0x0440_0000 * runs | (4 if self.error else 3 if runs or self.paused else 2) << 16
        x, y, z = (round(1000 * v) for v in self.axes.place_at(self.now_s))
        return struct.pack(">I4iI", flags, x, y, z, 0, int(self._program.modal.get("S", 4500))) + bytes(8)

    def _answer(self, register: int) -> bytes:
        slots = {0x030B: 1} | {0x3202 + i: 2 + i for i in range(9)}
        if register in slots:
            x, y, z = (round(1000 * v) for v in self.origins_mm.get(slots[register], (0.0, 0.0, 0.0)))
            return struct.pack(">4i", x, y, z, 0)
        return {
            0x0101: b"MDX-40A simulated\0",
            0x05F0: struct.pack(">8I", *[1_000_000] * 8),
            0x3804: bytes(24),
            0x3900: struct.pack(">I", 4500),
            0x3106: bytes([0, self.command_set, 0, 0, 0, 0]),
            0x2100: struct.pack(">5H", 0, self.error, 0, 0, 0),
        }.get(register, b"\0\0\0\0")

    # The program.

    def _work(self) -> None:
        """Take lines from the input while the block buffer has room; begin what is next."""
        program = self._program
        while not self.error and not self.paused:
            if self._begins_s() <= self.now_s:
                if program.parts:
                    program.go_on(self.now_s)
                else:
                    self.begun.append(self._held.popleft())
                    program.begin(self.begun[-1], self.now_s)
                continue
            end = self._input.find(b"\n")
            if end < 0 or len(self._held) >= self.blocks:
                return
            line = bytes(self._input[: end + 1])
            text = line.strip()
            if not program.language and text:
                program.language = ("rml", "nc", "nc" if text[:1] in (b"%", b"(") else "rml")[self.command_set]
            if program.is_refused(text):
                self._stop_by_error(ERROR_PROGRAM)
                return
            del self._input[: end + 1]
            self.counter = (self.counter + len(line)) & 0xFFFFFFFF
            if text:
                self._held.append(text)

    def _advance(self, to_s: float) -> None:
        while (at_s := min(self.axes.ends_s, self._begins_s())) <= to_s:
            self.now_s = max(self.now_s, at_s)
            if (done := self.axes.finish()) is not None:
                self._ready_s = self.now_s + self.gap_s
                self.cuts.append(done)
            self._work()
        self.now_s = max(self.now_s, to_s)

    def _begins_s(self) -> float:
        """When it takes up the next line or command it holds."""
        return self._ready_s if not self.idle and self.axes.move is None and not self.error and not self.paused else inf

    def _stop_by_error(self, error: int) -> None:
        self._stop()
        self._program.spindle_on, self.error = False, error

    def _stop(self) -> None:
        self.axes.stop(self.now_s)
        self._held.clear()
        self._program.parts.clear()


@dataclass(slots=True)
class UsbFace:
    """The same mill behind the calls that rollingmill's MdxUSB makes of pyusb: control transfers and an endpoint."""

    mill: SimulatedMdx40a

    def ctrl_transfer(
        self, kind: int, request: int, value: int, index: int, data_or_length: bytes | int, timeout: int = 0
    ) -> bytes:
        if request != 0x01 or index != 0 or kind not in (0x40, 0xC0):
            raise SimulatedUsbError(f"stalled: request type 0x{kind:02x}, request {request}")
        if isinstance(data_or_length, int):
            return self.mill.vend_get(value, data_or_length)
        header = bytes([0x01, value >> 8, value & 0xFF, 0x00])
        if data_or_length[:4] != header:
            raise SimulatedUsbError("stalled: header of the data stage")
        self.mill.vend_set(value, data_or_length[4:])
        return b""

    def write(self, data: bytes, timeout: int = 0) -> int:
        return self.mill.bulk_write(data)

    @property
    def _ctx(self) -> UsbFace:  # pyusb's resource manager, as far as releasing the interface asks for it
        return self

    def managed_release_interface(self, device: object, interface: int) -> None:
        self.mill.released += 1


def open_simulated(mill: SimulatedMdx40a) -> RollingmillDevice:
    """Our device on rollingmill's own link and machine, which think that they talk to pyusb."""
    machine, usb = pytest.importorskip("rollingmill.machine"), pytest.importorskip("rollingmill.usb")
    face = UsbFace(mill)
    link = usb.MdxUSB(face, 0, face, 2000)
    errors = (SimulatedUsbError,)
    return RollingmillDevice(link, machine.MDX40A(link), link_errors=errors, clock=mill.clock, wait=mill.wait)
