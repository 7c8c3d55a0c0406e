"""A simulated MDX-40A at the level of USB transfers, in simulated time, with the traits that its users found.

Vendor control transfers and bulk-out as rollingmill sends them. It ignores bytes outside the job bracket, counts bytes
when its small block buffer takes them (before they are cut), stops counting with the error bit up on a wrong command
set or a word its NC dialect does not know, hangs on writes of 32 KB, runs everything flat at Z0 as rapids once Z went
above machine zero, and stops at once when the cover opens in a cut. Until `power_cycle` an error stays.
"""

from __future__ import annotations

import re
import struct
from collections import deque
from dataclasses import dataclass, field
from math import dist, inf

RAPID_MM_PER_MIN = 3000.0
ERROR_PROGRAM, ERROR_COVER = 0x0F01, 0x0109  # the first is ours: what a refused block reports is not known
_WORD = re.compile(rb"([A-Z])([+-]?[0-9.]+)")
_CONSTANT = 0x0000_081C


class SimulatedUsbError(Exception):
    """What libusb would raise: timeout, no device."""


@dataclass(frozen=True, slots=True)
class Cut:
    """A move as made, in machine coordinates [mm]."""

    line: bytes
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    rapid: bool


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
    origins_mm: dict[int, tuple[float, float, float]] = field(
        default_factory=lambda: {1: (50.0, 50.0, -40.0), 3: (50.0, 50.0, -40.0)}
    )

    now_s: float = 0.0
    cuts: list[Cut] = field(default_factory=list)
    begun: list[bytes] = field(default_factory=list)  # lines whose execution has begun
    ignored_bytes: int = 0
    counter: int = 0
    door_open: bool = False
    paused: bool = False
    spindle_on: bool = False
    unplugged: bool = False
    released: int = 0  # times the host has let go of the interface
    error: int = 0
    sets: list[tuple[int, bytes]] = field(default_factory=list)
    bracket: bool = False
    machine_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    _input: bytearray = field(default_factory=bytearray)
    _held: deque[bytes] = field(default_factory=deque)
    _parts: deque[tuple[bytes, bytes]] = field(default_factory=deque)  # RML-1 commands of the line that is begun
    _move: Cut | None = None
    _move_began_s: float = 0.0
    _move_ends_s: float = inf
    _language: str = ""
    _modal: dict[str, float] = field(default_factory=dict)
    _absolute: bool = True
    _motion: int = 0
    _flattened: bool = False
    _hung: bool = False
    _response: bytes = b""
    _ready_s: float = 0.0

    # Time.

    def clock(self) -> float:
        return self.now_s

    def wait(self, timeout_s: float) -> None:
        self._advance(self.now_s + timeout_s)

    @property
    def idle(self) -> bool:
        """Nothing moves and nothing is left to do."""
        return self._move is None and not self._held and not self._parts

    def press_view(self) -> None:
        """Pause; pressed for 3 s when paused: go on."""
        self._advance(self.now_s)
        if not self.paused and self._move is not None:
            self.machine_mm = self._place()
            self._move = Cut(self._move.line, self.machine_mm, self._move.end_mm, self._move.rapid)
            self._move_ends_s = inf
        elif self.paused and self._move is not None:
            self._begin(self._move)
        self.paused = not self.paused

    def open_door(self) -> None:
        self._advance(self.now_s)
        self.door_open = True
        if self._move is not None or self.spindle_on or self._held:
            self._emergency(ERROR_COVER)

    def close_door(self) -> None:
        self.door_open = False

    def power_cycle(self) -> None:
        """All buffers gone; it homes by itself."""
        self.error, self._hung, self._flattened, self.paused = 0, False, False, False
        self._input.clear()
        self._drop()
        self._move, self._move_ends_s = None, inf
        self.counter, self.bracket, self._language, self.spindle_on = 0, False, "", False
        self._modal.clear()
        self.machine_mm = (0.0, 0.0, 0.0)

    # Transfers.

    def vend_set(self, wValue: int, data: bytes = b"") -> None:
        self._transfer()
        self.sets.append((wValue, data))
        if wValue == 0x1109:
            self.bracket = data == b"\x00"
            self._language = "" if self.bracket else self._language
        elif wValue == 0x03F3:
            self._drop()
            self._input.clear()
            self.machine_mm = self._place()
            self._move, self._move_ends_s = None, inf
        elif wValue == 0x3107:
            self.command_set = data[1]
        else:
            self._response = self._answer(wValue)

    def vend_get(self, wValue: int, length: int) -> bytes:
        self._transfer()
        return self._register(wValue)[:length]

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

    def release(self) -> None:
        pass

    def _transfer(self) -> None:
        if self.unplugged:
            raise SimulatedUsbError("no such device (it may have been disconnected)")
        self._advance(self.now_s + self.transfer_s)

    # Registers.

    def _register(self, number: int) -> bytes:
        match number:
            case 0x0001:
                return self._ping()
            case 0x0002:
                return b"\0\0\x12\x34"
            case 0x0003:
                return self._response
            case 0x0100:
                return self._state()
            case 0x0200:
                return struct.pack(">I", self.counter & 0xFFFFFFFF)
            case _:
                raise SimulatedUsbError(f"stalled: register 0x{number:04x}")

    def _ping(self) -> bytes:
        word = 0x0082_0800 | (0x0010_0000 if self.error else 0) | (0x4 if self._move else 0)
        return struct.pack("<I", word & 0x00FF_FFFF | min(len(self._response), 255) << 24)

    def _state(self) -> bytes:
        waiting = self.paused
        flags = _CONSTANT | (0x0080_0000 if not waiting else 0x4000_0000)
        flags |= 0x1000_0000 * self.door_open | 0x0800_0000 * self.spindle_on | 0x1000 * bool(self.error)
        runs = self._move is not None and not self.paused
        flags |= 0x0440_0000 * runs | (4 if self.error else 3 if runs or self.paused else 2) << 16
        x, y, z = (round(1000 * v) for v in self._place())
        return struct.pack(">I4iI", flags, x, y, z, 0, int(self._modal.get("S", 4500))) + bytes(8)

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
        while not self.error and not self.paused:
            if self._move is None and self._parts and self.now_s >= self._ready_s:
                self._execute_rml()
                continue
            if self._move is None and self._held and self.now_s >= self._ready_s:
                self._execute(self._held.popleft())
                continue
            end = self._input.find(b"\n")
            if end < 0 or len(self._held) >= self.blocks:
                return
            line = bytes(self._input[: end + 1])
            text = line.strip()
            if not self._language and text:
                sniffed = "nc" if text[:1] in (b"%", b"(") else "rml"
                self._language = {0: "rml", 1: "nc", 2: sniffed}[self.command_set]
            reason = self._refuses(text)
            if reason:
                self._emergency(ERROR_PROGRAM)
                return
            del self._input[: end + 1]
            self.counter = (self.counter + len(line)) & 0xFFFFFFFF
            if text:
                self._held.append(text)

    def _refuses(self, text: bytes) -> str:
        if not text:
            return ""
        if self._language == "rml":
            return "" if b";" in text else "not RML-1"
        if text == b"%" or text[:1] in (b"O", b"("):
            return "" if text[:1] != b"O" or re.fullmatch(rb"O\d{8}", text) else "O takes eight digits"
        if not re.fullmatch(rb"([A-Z][+-]?[0-9.]+\s*)+", text):
            return "not NC code"
        words = [(letter.decode(), value) for letter, value in _WORD.findall(text)]
        codes = [value for letter, value in words if letter == "G"]
        for letter, value in words:
            if letter in "GM" and len(value.split(b".")[0]) != 2:
                return f"{letter} takes two digits"
            if letter in "XYZFIJR" and (b"." not in value or len(value.split(b".")[1]) > 3):
                return f"{letter} takes a decimal point and at most three decimals"
        absolute = b"91" not in codes and (self._absolute or b"90" in codes)
        if b"53" in codes and not absolute:
            return "G53 in G91"
        self._absolute = absolute
        for letter, value in words:
            if letter in "SF":
                self._modal[letter] = float(value)
            if letter == "M" and value in (b"03", b"05"):
                self._modal["M"] = float(value)
        if any(code in (b"01", b"02", b"03") for code in codes) and not (
            "S" in self._modal and self._modal.get("M") == 3
        ):
            return "G01 before S and M03"
        return ""

    def _execute(self, text: bytes) -> None:
        self.begun.append(text)
        if self._language == "rml":
            self._parts.extend((text, part.strip().lstrip(b"^")) for part in text.split(b";"))
            self._execute_rml()
            return
        words = {letter.decode(): float(value) for letter, value in _WORD.findall(text)}
        for letter, value in _WORD.findall(text):
            if letter == b"G" and value in (b"00", b"01"):
                self._motion = int(value)
            if letter == b"M" and value in (b"03", b"05", b"02", b"30"):
                self.spindle_on = value == b"03"
        if not words.keys() & set("XYZ") or b"G53" in text:
            return
        origin = self.origins_mm.get(3, (0.0, 0.0, 0.0))
        end = [words[a] + o if a in words else now for a, o, now in zip("XYZ", origin, self.machine_mm, strict=True)]
        feed = RAPID_MM_PER_MIN if self._motion == 0 else self._modal.get("F", 60.0)
        self._go(text, (end[0], end[1], end[2]), feed, self._motion == 0)

    def _execute_rml(self) -> None:
        """Commands of the line up to and including the next that moves. A lift beyond the top ends at the top."""
        while self._parts and self._move is None:
            text, part = self._parts.popleft()
            if part.startswith(b"!MC"):
                self.spindle_on = part != b"!MC0"
            elif part.startswith(b"V"):
                self._modal["F"] = 60 * float(part[1:])
            elif part in (b"PR", b"PA", b"DF", b"IN"):
                self._absolute = part != b"PR"
            elif part.startswith(b"Z"):
                base = self.origins_mm[1] if self._absolute else self.machine_mm
                x, y, z = (float(v) / 100 + o for v, o in zip(part[1:].split(b","), base, strict=True))
                self._go(text, (x, y, min(z, 0.0)), self._modal.get("F", 600.0), False)

    def _go(self, text: bytes, end_mm: tuple[float, float, float], feed_mm_per_min: float, rapid: bool) -> None:
        if end_mm[2] > 1e-9:
            self._flattened = True
        if self._flattened:
            end_mm, feed_mm_per_min, rapid = (end_mm[0], end_mm[1], 0.0), RAPID_MM_PER_MIN, True
        self._modal["speed"] = feed_mm_per_min
        if end_mm != self.machine_mm:
            self._begin(Cut(text, self.machine_mm, end_mm, rapid))

    def _begin(self, move: Cut) -> None:
        self._move, self._move_began_s = move, self.now_s
        self._move_ends_s = self.now_s + 60 * dist(move.start_mm, move.end_mm) / self._modal["speed"]

    def _place(self) -> tuple[float, float, float]:
        move = self._move
        if move is None or self._move_ends_s == inf:
            return self.machine_mm
        share = (self.now_s - self._move_began_s) / max(self._move_ends_s - self._move_began_s, 1e-12)
        x, y, z = (a + min(1.0, share) * (b - a) for a, b in zip(move.start_mm, move.end_mm, strict=True))
        return (x, y, z)

    def _advance(self, to_s: float) -> None:
        while min(self._move_ends_s, self._begins_s()) <= to_s:
            move = self._move
            self.now_s = max(self.now_s, min(self._move_ends_s, self._begins_s()))
            if move is not None:
                self.machine_mm, self._move, self._move_ends_s = move.end_mm, None, inf
                self._ready_s = self.now_s + self.gap_s
                self.cuts.append(move)
            self._work()
        self.now_s = max(self.now_s, to_s)

    def _begins_s(self) -> float:
        """When it takes up the next line it holds."""
        waits = self._move is None and bool(self._held or self._parts) and not self.error and not self.paused
        return self._ready_s if waits else inf

    def _emergency(self, error: int) -> None:
        self.machine_mm = self._place()
        self._move, self._move_ends_s = None, inf
        self._drop()
        self.spindle_on, self.error = False, error

    def _drop(self) -> None:
        self._held.clear()
        self._parts.clear()


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
