"""RML-1 programs: the commands, their effects, and whether a whole program may be sent to a mill.

    facts = check_rml(chunks, profile)          raises ProgramRefusedError with the line and the command

RML-1 knows no work offset, no rapid and no line number: coordinates count from the user origin set at the mill, and
everything moves at the last V. Nothing in it reports to the host how far it has come.

Source: Roland's RML-1 programming guideline (2002): mode 1 `D F H I M R V W Z @ ^`, mode 2 `DF IN PA PD PR PU VS`,
common `!DW !MC !NR !PZ !RC !VZ !ZM !ZO !ZZ !ZE`; whole numbers -32768..32767, others up to 8388608. Ranges of V, W
and !RC on the MDX-40 branch: Autodesk's Roland RML post. Coordinates are whole hundredths of a millimetre; `^` calls
a mode 2 command from mode 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import dist, inf, nan

from machines.driver import Triple
from machines.errors import ProgramRefusedError
from machines.gcode.modal import UNKNOWN, Position, Step
from machines.gcode.text import show_line, strip_ends
from machines.preflight.way_in import Motion
from machines.profile import MachineProfile
from phrases.phrase import Phrase

UNIT_MM = 0.01
NO_HEIGHT = 10_500  # in units, and above: the mill stops at its top [src: posts lift by it, and go across at it]
FASTEST_MM_PER_S = 50.0  # V of the MDX-40: 3000 mm/min
LONGEST_DWELL_MS = 32767
MOST_COMMAND_BYTES = 256  # far longer than any usable command; a file without `;` is not RML
LARGEST = 8388608.0
SPEED_CODES = 15  # !RC 0..15: evenly from the slowest to the fastest spindle speed

_NAME = re.compile(rb"\^?(DF|IN|PA|PD|PR|PU|VS|![A-Z]{2}|[DFHIMRVWZ@])")
_NUMBER = re.compile(rb"[+-]?(\d+(\.\d*)?|\.\d+)\Z")
_LOOKS_LIKE_NC = re.compile(rb"[%(]|[GMNOST][0-9]")
_ORIGIN_WORDS = re.compile(rb"([XYZA][+-]?\d+)+\Z")


@dataclass(frozen=True, slots=True)
class Shape:
    """Parameters of one command: how many (any multiple of `group` beyond `least` if `repeats`), and their range."""

    least: int
    most: int
    low: float = -LARGEST
    high: float = LARGEST
    whole: bool = True
    repeats: bool = False


_XY = Shape(0, 2, repeats=True)
SHAPES = {
    "D": _XY, "I": _XY, "M": _XY, "R": _XY, "PA": _XY, "PR": _XY, "PD": _XY, "PU": _XY,
    "Z": Shape(3, 3, repeats=True), "!ZZ": Shape(3, 3, repeats=True),
    "!ZM": Shape(1, 1), "!PZ": Shape(1, 2), "@": Shape(0, 2),
    "V": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False), "F": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False),
    "VS": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False), "!VZ": Shape(1, 1, 0.1, FASTEST_MM_PER_S, whole=False),
    "W": Shape(1, 1, 1, LONGEST_DWELL_MS), "!DW": Shape(1, 1, 1, LONGEST_DWELL_MS),
    "!MC": Shape(0, 1, 0, 1), "!RC": Shape(1, 1, 0, 100000),
    "DF": Shape(0, 0), "IN": Shape(0, 0), "H": Shape(0, 0), "!NR": Shape(0, 0),
}  # fmt: skip
_NO_COMMAND = Phrase("is not an RML-1 command")
REFUSED = {
    "!ZO": Phrase("moves the zero of Z in the middle of a job: set the zero at the mill"),
}


class RmlFault(ValueError):
    """A command with a fault; the message describes it."""

    def __init__(self, words: Phrase) -> None:
        super().__init__(words)


@dataclass(frozen=True, slots=True)
class Command:
    """One command: its name without `^`, its numbers as they stand (hundredths of a mm, mm/s, ms ...)."""

    name: str
    numbers: tuple[float, ...]
    words: bytes = b""  # !ZE: axis words


def parse(text: bytes) -> Command | None:
    """Return the command in `text` (no `;`); None for an empty one. RmlFault says what is wrong."""
    body = text.strip()
    if not body:
        return None
    if len(body) > MOST_COMMAND_BYTES:
        raise RmlFault(
            Phrase(
                "{count} bytes without ';' are not an RML-1 command (at most {most})",
                count=len(body),
                most=MOST_COMMAND_BYTES,
            )
        )
    found = _NAME.match(body)
    if not found:
        if _LOOKS_LIKE_NC.match(body):
            raise RmlFault(Phrase('is not an RML-1 command; NC code needs a machine with dialect = "roland-nc"'))
        raise RmlFault(_NO_COMMAND)
    if b"\n" in body:  # the mill is fed by lines, and recovery counts lines
        raise RmlFault(Phrase("goes on in the next line; end each command with ';' on its own line"))
    name = found[1].decode("ascii")
    rest = body[found.end() :].strip()
    if name in REFUSED:
        raise RmlFault(REFUSED[name])
    if name == "!ZE":
        if not _ORIGIN_WORDS.match(rest):
            raise RmlFault(Phrase("!ZE takes axis words such as X0Y0"))
        return Command(name, (), rest)
    if name not in SHAPES:
        raise RmlFault(_NO_COMMAND)
    shape = SHAPES[name]
    numbers = tuple(_number(part, shape) for part in re.split(rb"[,\s]+", rest)) if rest else ()
    _count(name, numbers, shape)
    return Command(name, numbers)


def spindle_rpm(code: float, slowest: float, fastest: float) -> float:
    """Return the speed for `!RC code`: 0..15 evenly over the range; more is the speed itself."""
    return slowest + code * (fastest - slowest) / SPEED_CODES if code <= SPEED_CODES else code


def _number(part: bytes, shape: Shape) -> float:
    if not _NUMBER.match(part):
        raise RmlFault(Phrase("'{text}' is not a number", text=show_line(part)))
    if shape.whole and b"." in part:
        raise RmlFault(
            Phrase("{text} must be a whole number (coordinates are hundredths of a millimetre)", text=part.decode())
        )
    value = float(part)
    if not shape.low <= value <= shape.high:
        raise RmlFault(
            Phrase("{text} is outside {low:g}..{high:g}", text=part.decode(), low=shape.low, high=shape.high)
        )
    return value


def _count(name: str, numbers: tuple[float, ...], shape: Shape) -> None:
    n = len(numbers)
    ok = n % shape.most == 0 and n >= shape.least if shape.repeats else shape.least <= n <= shape.most
    if not ok:
        wanted = str(shape.least)
        if shape.least != shape.most:
            wanted = Phrase("{least} to {most}", least=shape.least, most=shape.most)
        if shape.repeats:
            raise RmlFault(
                Phrase(
                    "{name} takes {wanted} numbers (or sets of them), not {count}", name=name, wanted=wanted, count=n
                )
            )
        raise RmlFault(Phrase("{name} takes {wanted} numbers, not {count}", name=name, wanted=wanted, count=n))


_ABSOLUTE_XY = {"D": True, "M": False, "PD": True, "PU": False}  # name -> does it cut (tool at Z1) or pass over (Z2)
_RELATIVE_XY = {"I": True, "R": False}


@dataclass(slots=True)
class RmlInterpreter:
    """Modal state of RML-1; `take` carries out one command."""

    position_mm: Position = UNKNOWN
    relative: bool = False
    feed_mm_per_s: float | None = None
    spindle_on: bool = False
    heights_mm: tuple[float, float] = (0.0, 0.0)  # Z1 (down), Z2 (up) of the two-height commands

    def take(self, command: Command) -> tuple[Step, ...]:
        """Return the moves that `command` makes. RmlFault where they cannot be known to be safe."""
        name, numbers = command.name, command.numbers
        match name:
            case "DF" | "IN":
                self.relative, self.spindle_on = False, False
            case "V" | "F" | "VS" | "!VZ":
                self.feed_mm_per_s = numbers[0]
            case "!MC":
                self.spindle_on = not numbers or numbers[0] == 1
            case "!PZ" | "@":
                self.heights_mm = (numbers[0] * UNIT_MM, numbers[-1] * UNIT_MM) if numbers else self.heights_mm
            case "PA" | "PR":
                self.relative = name == "PR"
                return self._travel(numbers, self.position_mm[2], self.relative)
            case "D" | "M" | "PD" | "PU":
                relative = self.relative and name.startswith("P")
                return self._travel(numbers, self.heights_mm[0 if _ABSOLUTE_XY[name] else 1], relative)
            case "I" | "R":
                return self._travel(numbers, self.heights_mm[0 if _RELATIVE_XY[name] else 1], True)
            case "Z" | "!ZZ":
                return tuple(self._to(numbers[i : i + 3]) for i in range(0, len(numbers), 3))
            case "!ZM":
                x, y, _ = self.position_mm
                return (self._move((x, y, numbers[0] * UNIT_MM)),)
            case "H" | "!ZE":
                self.position_mm = UNKNOWN
            case _:
                pass
        return ()

    def _travel(self, numbers: tuple[float, ...], z_mm: float | None, relative: bool) -> tuple[Step, ...]:
        moves = [self._move((*self.position_mm[:2], z_mm))] if z_mm != self.position_mm[2] else []
        for i in range(0, len(numbers), 2):
            x, y = (n * UNIT_MM for n in numbers[i : i + 2])
            moves.append(self._move((self._along(0, x, relative), self._along(1, y, relative), z_mm)))
        return tuple(moves)

    def _to(self, numbers: tuple[float, ...]) -> Step:
        x, y, z = (n * UNIT_MM for n in numbers)
        if self.relative and x == y == 0 and z > 0:  # the usual lift off the part: the mill stops it at its top
            return self._move((*self.position_mm[:2], None), at_top=numbers[2] >= NO_HEIGHT)
        if not self.relative and numbers[2] >= NO_HEIGHT:  # across along the top
            return self._move((x, y, None), at_top=True)
        return self._move(
            (self._along(0, x, self.relative), self._along(1, y, self.relative), self._along(2, z, self.relative))
        )

    def _along(self, axis: int, value_mm: float, relative: bool) -> float:
        before = self.position_mm[axis]
        if not relative:
            return value_mm
        if before is None:
            raise RmlFault(Phrase("moves relative to a position that no command before it has given"))
        return before + value_mm

    def _move(self, end_mm: Position, *, at_top: bool = False) -> Step:
        if self.feed_mm_per_s is None:
            raise RmlFault(Phrase("moves before any speed was set (V)"))
        start_mm, self.position_mm = self.position_mm, end_mm
        z, before = end_mm[2], start_mm[2]
        lifts = before is not None and z is not None and z > before and end_mm[:2] == start_mm[:2]
        if z is not None and z < 0 and not lifts and not self.spindle_on:
            raise RmlFault(
                Phrase("goes to Z {z_mm:g} mm, below the user origin, with the spindle off (!MC1 first)", z_mm=z)
            )
        known = [(a, b) for a, b in zip(start_mm, end_mm, strict=True) if a is not None and b is not None]
        length_mm = dist([a for a, _ in known], [b for _, b in known])
        top = (None, None, inf) if at_top else None
        return Step("feed", start_mm, end_mm, self.feed_mm_per_s * 60, length_mm, machine_mm=top)


@dataclass(frozen=True, slots=True, kw_only=True)
class RmlFacts:
    """Facts about a whole program. Bounds in the user frame, lowest and highest corner; None if it never moves.

    time_s : distance over speed, each axis at most at its rate; without acceleration, so the mill takes longer
    ends   : the program ends with the spindle off
    motions, way_in, last_z_mm : as in `machines.preflight.rules.Reading`
    """

    bounds_mm: tuple[Triple, Triple] | None
    lines: int
    commands: int
    bytes: int
    path_length_mm: float
    time_s: float
    feeds_mm_per_min: tuple[float, float] | None
    spindle_rpm: tuple[float, float] | None
    ends: bool
    motions: int
    way_in: tuple[Motion, ...]
    last_z_mm: float


@dataclass(slots=True)
class _Tally:
    low: list[float] = field(default_factory=lambda: [inf, inf, inf])
    high: list[float] = field(default_factory=lambda: [-inf, -inf, -inf])
    commands: int = 0
    motions: int = 0
    way_in: list[Motion] = field(default_factory=list)
    given: set[str] = field(default_factory=set)
    last_z_mm: float = -inf
    path_length_mm: float = 0.0
    time_s: float = 0.0
    feeds: tuple[float, float] | None = None
    speeds: tuple[float, float] | None = None


def check_rml(chunks: Iterable[bytes], profile: MachineProfile) -> RmlFacts:
    """Read a program of any size once; ProgramRefusedError names line, command and reason."""
    mill, tally, line, size = RmlInterpreter(), _Tally(), 1, 0
    for line, text, size in _commands(chunks):  # noqa: B007 (the last ones are the size of the file)
        try:
            tally.commands += bool(text.strip())
            command = parse(text)
            if command is not None:
                _count_command(command, line, mill, tally, profile)
        except RmlFault as fault:
            where = Phrase("{fault} (command {count} of the program)", fault=str(fault), count=tally.commands)
            raise ProgramRefusedError(line, show_line(text.lstrip().split(b"\n")[0][:60]), where) from None
    if not tally.commands:
        raise ProgramRefusedError(0, "", Phrase("the file holds no RML-1 command"))
    moved = all(value < inf for value in tally.low)
    return RmlFacts(
        bounds_mm=((tally.low[0], tally.low[1], tally.low[2]), (tally.high[0], tally.high[1], tally.high[2]))
        if moved
        else None,
        lines=line,
        commands=tally.commands,
        bytes=size,
        path_length_mm=tally.path_length_mm,
        time_s=tally.time_s,
        feeds_mm_per_min=tally.feeds,
        spindle_rpm=tally.speeds,
        ends=not mill.spindle_on,
        motions=tally.motions,
        way_in=tuple(tally.way_in),
        last_z_mm=tally.last_z_mm,
    )


def _count_motion(move: Step, line: int, tally: _Tally) -> None:
    """Note a motion's height at its end, and the motion itself where X, Y and Z are not all given yet."""
    tally.motions += 1
    z = move.end_mm[2]
    tally.last_z_mm = nan if move.machine_mm is not None else tally.last_z_mm if z is None else z
    if len(tally.given) < 3:
        ends = zip("XYZ", move.start_mm, move.end_mm, strict=True)
        moved = {axis for axis, start, end in ends if end is not None and end != start}
        tally.given |= moved
        tally.way_in.append(Motion(line, move, "".join(sorted(moved | ({"Z"} if move.machine_mm else set())))))


def _count_command(command: Command, line: int, mill: RmlInterpreter, tally: _Tally, profile: MachineProfile) -> None:
    if command.name == "!RC":
        slowest, fastest = profile.spindle_rpm
        speed = spindle_rpm(command.numbers[0], slowest, fastest)
        if not slowest <= speed <= fastest:
            raise RmlFault(
                Phrase(
                    "{speed_rpm:g} rpm is outside the spindle's {slowest_rpm:g}..{fastest_rpm:g} (or a code 0..15)",
                    speed_rpm=speed,
                    slowest_rpm=slowest,
                    fastest_rpm=fastest,
                )
            )
        tally.speeds = _widen(tally.speeds, speed)
    for move in mill.take(command):
        feed = move.feed_mm_per_min
        assert feed is not None  # or the move would have been refused
        _count_motion(move, line, tally)
        tally.path_length_mm += move.length_mm
        tally.time_s += _move_time_s(move, feed, profile)
        tally.feeds = _widen(tally.feeds, feed)
        for axis, value in enumerate(move.end_mm):
            if value is None:
                continue
            tally.low[axis] = min(tally.low[axis], value)
            tally.high[axis] = max(tally.high[axis], value)
            extent = tally.high[axis] - tally.low[axis]
            if extent > profile.travel_mm[axis]:
                raise RmlFault(
                    Phrase(
                        "the program now spans {extent_mm:.2f} mm in {axis}, "
                        "the travel of {machine} is {travel_mm:g} mm",
                        extent_mm=extent,
                        axis="XYZ"[axis],
                        machine=profile.name,
                        travel_mm=profile.travel_mm[axis],
                    )
                )
    if command.name in ("W", "!DW"):
        tally.time_s += command.numbers[0] / 1000


def _move_time_s(move: Step, feed_mm_per_min: float, profile: MachineProfile) -> float:
    times = [move.length_mm / feed_mm_per_min]
    for a, b, rate in zip(move.start_mm, move.end_mm, profile.max_rate_mm_per_min, strict=True):
        times.append(abs(b - a) / rate if a is not None and b is not None else 0.0)
    return 60 * max(times)


def _widen(span: tuple[float, float] | None, value: float) -> tuple[float, float]:
    return (value, value) if span is None else (min(span[0], value), max(span[1], value))


def _commands(chunks: Iterable[bytes]) -> Iterator[tuple[int, bytes, int]]:
    """Yield (line, command without ';', bytes of the file up to here); a command may be cut anywhere by the chunks."""
    line, size, rest = 1, 0, b""
    for chunk in chunks:
        size += len(chunk)
        *whole, rest = (rest + chunk).split(b";")
        for text in whole:
            blank = text[: len(text) - len(text.lstrip())]
            yield line + blank.count(b"\n"), text, size
            line += text.count(b"\n")
        if len(rest.strip()) > MOST_COMMAND_BYTES:
            yield line, rest, size  # refused by its length: no need to read on
    end = strip_ends(rest)
    if end:
        line += rest[: rest.find(end)].count(b"\n")
        reason = Phrase("the last command has no ';': is the file cut off, or not RML-1?")
        raise ProgramRefusedError(line, show_line(end.split(b"\n")[0][:60]), reason)
    yield line + max(rest.count(b"\n") - 1, 0), b"", size
