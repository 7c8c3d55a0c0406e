"""What a simulated MDX-40A makes of its blocks: which it refuses, what they switch, and how the axes move."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, field
from math import dist, inf

from machines.driver import Triple

RAPID_MM_PER_MIN = 3000.0
_WORD = re.compile(rb"([A-Z])([+-]?[0-9.]+)")
_ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Cut:
    """A move as made, in machine coordinates [mm]."""

    line: bytes
    start_mm: Triple
    end_mm: Triple
    rapid: bool


@dataclass(slots=True)
class SimulatedAxes:
    """One straight move at a time. Once Z went above machine zero, everything runs flat at Z0 as rapids."""

    machine_mm: Triple = _ZERO  # before the move under way
    move: Cut | None = None
    ends_s: float = inf  # of the move; inf where none is under way, or it is paused
    flattened: bool = False
    _began_s: float = 0.0
    _mm_per_min: float = RAPID_MM_PER_MIN

    def go(self, line: bytes, end_mm: Triple, mm_per_min: float, now_s: float, *, rapid: bool) -> None:
        if end_mm[2] > 1e-9:
            self.flattened = True
        if self.flattened:
            end_mm, mm_per_min, rapid = (end_mm[0], end_mm[1], 0.0), RAPID_MM_PER_MIN, True
        self._mm_per_min = mm_per_min
        if end_mm != self.machine_mm:
            self._begin(Cut(line, self.machine_mm, end_mm, rapid), now_s)

    def _begin(self, move: Cut, now_s: float) -> None:
        self.move, self._began_s = move, now_s
        self.ends_s = now_s + 60 * dist(move.start_mm, move.end_mm) / self._mm_per_min

    def place_at(self, now_s: float) -> Triple:
        """Return the machine position."""
        move = self.move
        if move is None or self.ends_s == inf:
            return self.machine_mm
        share = (now_s - self._began_s) / max(self.ends_s - self._began_s, 1e-12)
        x, y, z = (a + min(1.0, share) * (b - a) for a, b in zip(move.start_mm, move.end_mm, strict=True))
        return (x, y, z)

    def pause(self, now_s: float) -> None:
        if self.move is not None:
            self.machine_mm = self.place_at(now_s)
            self.move = Cut(self.move.line, self.machine_mm, self.move.end_mm, self.move.rapid)
            self.ends_s = inf

    def resume(self, now_s: float) -> None:
        if self.move is not None:
            self._begin(self.move, now_s)

    def finish(self) -> Cut | None:
        """End the move under way where it leads; return it."""
        move = self.move
        if move is not None:
            self.machine_mm, self.move, self.ends_s = move.end_mm, None, inf
        return move

    def stop(self, now_s: float) -> None:
        self.machine_mm, self.move, self.ends_s = self.place_at(now_s), None, inf


@dataclass(slots=True)
class BlockInterpreter:
    """Reads blocks: NC code whole, RML-1 command by command.

    parts : RML-1 commands of the line that is begun, each with its line
    """

    axes: SimulatedAxes
    origins_mm: dict[int, Triple]
    language: str = ""
    spindle_on: bool = False
    modal: dict[str, float] = field(default_factory=dict)
    parts: deque[tuple[bytes, bytes]] = field(default_factory=deque)
    _absolute: bool = True
    _motion: int = 0

    def is_refused(self, text: bytes) -> bool:
        """Whether the mill stops at this block with its error bit up. Reads S, F, M and G90 of one it takes."""
        if not text:
            return False
        if self.language == "rml":
            return b";" not in text
        if text == b"%" or text[:1] in (b"O", b"("):
            return text[:1] == b"O" and re.fullmatch(rb"O\d{8}", text) is None
        if not re.fullmatch(rb"([A-Z][+-]?[0-9.]+\s*)+", text):
            return True
        words = [(letter.decode(), value) for letter, value in _WORD.findall(text)]
        codes = {value for letter, value in words if letter == "G"}
        absolute = b"91" not in codes and (self._absolute or b"90" in codes)
        if not all(_is_well_written(*word) for word in words) or (b"53" in codes and not absolute):
            return True
        self._absolute = absolute
        self.modal |= {a: float(v) for a, v in words if a in "SF" or (a == "M" and v in (b"03", b"05"))}
        return bool(codes & {b"01", b"02", b"03"}) and not ("S" in self.modal and self.modal.get("M") == 3)

    def begin(self, text: bytes, now_s: float) -> None:
        """Carry out a block; of RML-1 up to its first move."""
        if self.language == "rml":
            self.parts.extend((text, part.strip().lstrip(b"^")) for part in text.split(b";"))
            self.go_on(now_s)
            return
        if text[:1] == b"(":
            return
        words = {letter.decode(): float(value) for letter, value in _WORD.findall(text)}
        for letter, value in _WORD.findall(text):
            if letter == b"G" and value in (b"00", b"01"):
                self._motion = int(value)
            if letter == b"M" and value in (b"03", b"05", b"02", b"30"):
                self.spindle_on = value == b"03"
        if not words.keys() & set("XYZ"):
            return
        origin_mm = _ZERO if b"G53" in text else self.origins_mm.get(3, _ZERO)
        places = zip("XYZ", origin_mm, self.axes.machine_mm, strict=True)
        x, y, z = (words[axis] + origin if axis in words else now for axis, origin, now in places)
        feed = RAPID_MM_PER_MIN if self._motion == 0 else self.modal.get("F", 60.0)
        self.axes.go(text, (x, y, z), feed, now_s, rapid=self._motion == 0)

    def go_on(self, now_s: float) -> None:
        """Carry out RML-1 up to and including the next command that moves. A lift beyond the top ends at the top."""
        while self.parts and self.axes.move is None:
            text, part = self.parts.popleft()
            if part.startswith(b"!MC"):
                self.spindle_on = part != b"!MC0"
            elif part.startswith(b"V"):
                self.modal["F"] = 60 * float(part[1:])
            elif part in (b"PR", b"PA", b"DF", b"IN"):
                self._absolute = part != b"PR"
            elif part.startswith(b"Z"):
                base = self.origins_mm[1] if self._absolute else self.axes.machine_mm
                x, y, z = (float(v) / 100 + o for v, o in zip(part[1:].split(b","), base, strict=True))
                self.axes.go(text, (x, y, min(z, 0.0)), self.modal.get("F", 600.0), now_s, rapid=False)


def _is_well_written(letter: str, value: bytes) -> bool:
    """Codes have two digits, coordinates and feeds a decimal point and at most three decimals."""
    whole, point, decimals = value.partition(b".")
    if letter in "GM":
        return len(whole) == 2
    return letter not in "XYZFIJR" or (point != b"" and len(decimals) <= 3)
