"""Faults on the wire and at the mill, by plan or by seed: finds which byte, line or reply of the plan is due, applies
the fault, and logs it.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from machines.simulated.firmware import Firmware
from machines.simulated.serial_side import SerialSide

# Faults of one byte on the way to the mill ("sent") or back ("reply").
SENT_KINDS = ("drop", "flip", "duplicate", "delay")
REPLY_KINDS = ("lose-reply", "duplicate-reply", "mangle-reply", "drop-reply-byte", "delay-reply")
MILL_KINDS = ("disconnect", "power-cycle", "reset-button", "hold-button", "start-button", "door", "eeprom-stall")
KINDS = (*SENT_KINDS, *REPLY_KINDS, *MILL_KINDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault. Exactly one of byte, line and at_s gives its time.

    byte      : index of the byte on the wire, from 0: to the mill for SENT_KINDS and MILL_KINDS, from it for replies
    line      : with that line end received (from 1), or that `ok`/`error` reply sent (REPLY_KINDS)
    at_s      : simulated time
    mask      : bits turned over by "flip" and "mangle-reply"
    length_s  : of a delay, an EEPROM stall, a disconnect (0: stays away until replug), an open door
    """

    kind: str
    byte: int | None = None
    line: int | None = None
    at_s: float | None = None
    mask: int = 0x01
    length_s: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"fault '{self.kind}' is unknown; known: {', '.join(KINDS)}")
        if sum(v is not None for v in (self.byte, self.line, self.at_s)) != 1:
            raise ValueError(f"fault '{self.kind}' needs exactly one of byte, line and at_s to say when")


@dataclass(frozen=True, slots=True)
class FaultDone:
    """A fault as it was carried out: time, kind, byte index on its wire, lines the mill had received."""

    at_s: float
    kind: str
    byte: int
    line: int
    words: str = ""


@dataclass(slots=True)
class Faults:
    """A plan of faults and the log of those that happened."""

    plan: Sequence[Fault] = ()
    log: list[FaultDone] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.plan = tuple(self.plan)

    @classmethod
    def by_seed(
        cls, seed: int, *, kinds: Iterable[str] = KINDS, count: int = 1, lines: tuple[int, int] = (20, 1000)
    ) -> Faults:
        """Return `count` faults of these kinds at random lines in the given range (first, last)."""
        chance = random.Random(seed)
        kinds = tuple(kinds)
        plan = [_random_fault(chance, chance.choice(kinds), lines) for _ in range(count)]
        return cls(plan)


def _random_fault(chance: random.Random, kind: str, lines: tuple[int, int]) -> Fault:
    line = chance.randint(*lines)
    length_s = {"delay": 0.5, "delay-reply": 0.5, "eeprom-stall": 0.02, "disconnect": 2.0, "door": 3.0}.get(kind, 0.0)
    if kind in SENT_KINDS or kind == "drop-reply-byte":
        # A byte near the middle of the lines, assuming 20 bytes for a line and 4 for an ok.
        per_line = 4 if kind == "drop-reply-byte" else 20
        byte = line * per_line + chance.randrange(per_line)
        return Fault(kind=kind, byte=byte, mask=1 << chance.randrange(7), length_s=length_s * chance.random())
    return Fault(kind=kind, line=line, mask=1 << chance.randrange(7), length_s=length_s * (0.5 + chance.random()))


def parse_fault(text: str) -> Fault:
    """ "kind@line=120", "kind@byte=4711", "kind@t=12.5", with ":length" seconds appended if it has a duration."""
    kind, _, rest = text.partition("@")
    when, _, length = rest.partition(":")
    name, _, value = when.partition("=")
    try:
        length_s = float(length) if length else 0.0
        if name == "line":
            return Fault(kind=kind, line=int(value), length_s=length_s)
        if name == "byte":
            return Fault(kind=kind, byte=int(value), length_s=length_s)
        if name == "t":
            return Fault(kind=kind, at_s=float(value), length_s=length_s)
    except ValueError as error:
        if kind not in KINDS:
            raise
        raise ValueError(f"fault '{text}': {error}") from None
    raise ValueError(f"fault '{text}' is not understood: write kind@line=N, kind@byte=N or kind@t=SECONDS")


class Wired(Protocol):
    """The interface of the mill at the end of a wire."""

    @property
    def now_s(self) -> float: ...
    @property
    def firmware(self) -> Firmware: ...
    @property
    def serial(self) -> SerialSide: ...

    def call_at(self, time_s: float, event: Callable[[], None]) -> None: ...

    def carry_out(self, fault: Fault, byte: int) -> None: ...


class FaultWire:
    """Counts bytes, lines and replies of a mill's wire and applies the plan to them.

    active : there is a plan; without one the wire is not examined
    """

    def __init__(self, faults: Faults, mill: Wired) -> None:
        self._log = faults.log
        self._mill = mill
        self._sent = [f for f in faults.plan if f.kind in SENT_KINDS and f.at_s is None]
        self._mill_faults = [f for f in faults.plan if f.kind in MILL_KINDS and f.at_s is None]
        self._replies = [f for f in faults.plan if f.kind in REPLY_KINDS]
        self._late = [f for f in faults.plan if f.kind in SENT_KINDS and f.at_s is not None]
        self.active = bool(self._sent or self._mill_faults or self._replies or self._late)
        self._bytes = self._lines = self._reply_bytes = self._answers = 0
        self._due: dict[int, list[Fault]] = {}
        for fault in faults.plan:
            if fault.kind in MILL_KINDS and fault.at_s is not None:
                mill.call_at(fault.at_s, lambda f=fault: mill.carry_out(f, self._bytes))  # type: ignore[misc]

    def note(self, fault: Fault, byte: int, words: str = "") -> None:
        self._log.append(FaultDone(self._mill.now_s, fault.kind, byte, self._mill.firmware.received, words))

    # -- to the mill -----------------------------------------------------------------------------------------------
    def carry(self, data: bytes, at_s: float) -> None:
        """Pass data to the UART with the faults that fall into it."""
        serial = self._mill.serial
        first, self._bytes = self._bytes, self._bytes + len(data)
        start = 0
        for k in self._take_due_bytes(data, first, at_s):
            if k > start:
                serial.receive(data[start:k], at_s)
            changed = self._one_byte(data[k : k + 1], first + k, self._due[k])
            if changed:
                serial.receive(changed, at_s)
            start = k + 1
        if start < len(data):
            serial.receive(data[start:], at_s)

    def _take_due_bytes(self, data: bytes, first: int, at_s: float) -> list[int]:
        """Return offsets in data at which something of the plan falls due."""
        self._due = {}
        for fault in [*self._sent, *self._mill_faults]:
            if fault.byte is not None and first <= fault.byte < first + len(data):
                self._due.setdefault(fault.byte - first, []).append(fault)
        wanted = {f.line: f for f in [*self._sent, *self._mill_faults] if f.line is not None}
        for k, byte in enumerate(data):
            if byte == 10:
                self._lines += 1
                if self._lines in wanted:
                    self._due.setdefault(k, []).append(wanted[self._lines])
        for fault in list(self._late):
            if fault.at_s is not None and at_s >= fault.at_s:
                self._late.remove(fault)
                self._due.setdefault(0, []).append(fault)
        return sorted(self._due)

    def _one_byte(self, byte: bytes, index: int, faults: list[Fault]) -> bytes:
        serial, mill = self._mill.serial, self._mill
        for fault in faults:
            if fault.kind == "drop":
                self.note(fault, index, repr(byte))
                byte = b""
            elif fault.kind == "flip":
                turned = bytes(b ^ fault.mask for b in byte)
                self.note(fault, index, f"{byte!r} became {turned!r}")
                byte = turned
            elif fault.kind == "duplicate":
                self.note(fault, index, repr(byte))
                byte = byte * 2
            elif fault.kind == "delay":
                self.note(fault, index)
                serial.wire_free_s = max(serial.wire_free_s, mill.now_s) + fault.length_s
            else:
                arrives = max(serial.wire_free_s, mill.now_s) + serial.byte_s
                mill.call_at(arrives, lambda f=fault: mill.carry_out(f, index))  # type: ignore[misc]
        return byte

    # -- from the mill ---------------------------------------------------------------------------------------------
    def reply(self, data: bytes) -> bytes:
        """Return the bytes that are really sent in place of these."""
        first, self._reply_bytes = self._reply_bytes, self._reply_bytes + len(data)
        answer = data.startswith((b"ok", b"error"))
        self._answers += answer
        for fault in self._replies:
            if fault.line is not None:
                due = answer and fault.line == self._answers
            elif fault.byte is not None:
                due = first <= fault.byte < first + len(data)
            else:
                due = False
            if due:
                data = self._spoil(fault, data, first)
        for fault in list(self._replies):
            if fault.at_s is not None and self._mill.now_s >= fault.at_s:
                self._replies.remove(fault)
                data = self._spoil(fault, data, first)
        return data

    def _spoil(self, fault: Fault, data: bytes, first: int) -> bytes:
        self.note(fault, first, repr(data))
        k = min(max((fault.byte or first) - first, 0), max(len(data) - 1, 0))
        if fault.kind == "lose-reply":
            return b""
        if fault.kind == "duplicate-reply":
            return data * 2
        if fault.kind == "mangle-reply":
            return data[:k] + bytes([data[k] ^ fault.mask]) + data[k + 1 :] if data else data
        if fault.kind == "drop-reply-byte":
            return data[:k] + data[k + 1 :]
        serial = self._mill.serial
        serial.tx_free_s = max(serial.tx_free_s, self._mill.now_s) + fault.length_s
        return data
