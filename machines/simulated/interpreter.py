"""Modal state and the meaning of a line: error checks in the firmware's order, targets in machine coordinates; and
arcs, their centre from I, J, K or R, and the chords that the firmware cuts instead ($12).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import atan2, cos, hypot, pi, sin, sqrt

from machines.simulated.words import GcodeError, Words, read_words

Triple = tuple[float, float, float]
PLANES = {"G17": (0, 1, 2), "G18": (2, 0, 1), "G19": (1, 2, 0)}
_SAME_ANGLE = 5e-7  # rad: a turn smaller than this is taken as a whole circle
ZERO: Triple = (0.0, 0.0, 0.0)
INCH_MM = 25.4
SYSTEMS = ("G54", "G55", "G56", "G57", "G58", "G59")
_MOST_N = 10_000_000
_START = {
    "motion": "G0", "plane": "G17", "distance": "G90", "feed-mode": "G94", "units": "G21", "wcs": "G54",
    "tool-length": "G49", "spindle": "M5",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SimulatedArc:
    """From start to end about `centre` in `plane`, both in machine mm."""

    start: Triple
    end: Triple
    centre: tuple[float, float]
    radius_mm: float
    plane: tuple[int, int, int]
    clockwise: bool


def arc_from_radius(
    start: Triple, end: Triple, radius: float, plane: tuple[int, int, int], clockwise: bool
) -> SimulatedArc:
    """Return the arc of the R form: the shorter of the two, the longer one for a negative radius."""
    a, b, _ = plane
    dx, dy = end[a] - start[a], end[b] - start[b]
    chord = hypot(dx, dy)
    if start == end or chord == 0.0:
        raise GcodeError(33)
    square = 4 * radius * radius - chord * chord
    if square < 0:
        raise GcodeError(34)
    side = sqrt(square) / chord  # twice the height over the chord, over the chord
    if clockwise == (radius > 0):
        side = -side
    centre = (start[a] + 0.5 * (dx - dy * side), start[b] + 0.5 * (dy + dx * side))
    return SimulatedArc(start, end, centre, abs(radius), plane, clockwise)


def arc_from_offsets(
    start: Triple, end: Triple, offsets: tuple[float, float], plane: tuple[int, int, int], clockwise: bool
) -> SimulatedArc:
    """Return the arc of the I, J, K form; the two radii may differ by 0.005 mm, or by 0.1 % if that is less than 0.5
    mm.
    """
    a, b, _ = plane
    centre = (start[a] + offsets[0], start[b] + offsets[1])
    radius = hypot(*offsets)
    difference = abs(hypot(end[a] - centre[0], end[b] - centre[1]) - radius)
    if difference > 0.005 and (difference > 0.5 or difference > 0.001 * radius):
        raise GcodeError(33)
    return SimulatedArc(start, end, centre, radius, plane, clockwise)


def chords(arc: SimulatedArc, tolerance_mm: float) -> Iterator[Triple]:
    """End points of the chords, at most `tolerance_mm` from the arc; the last is the arc's end."""
    a, b, c = arc.plane
    first = atan2(arc.start[b] - arc.centre[1], arc.start[a] - arc.centre[0])
    last = atan2(arc.end[b] - arc.centre[1], arc.end[a] - arc.centre[0])
    turn = last - first
    if arc.clockwise:
        if turn >= -_SAME_ANGLE:
            turn -= 2 * pi
    elif turn <= _SAME_ANGLE:
        turn += 2 * pi
    inner = tolerance_mm * (2 * arc.radius_mm - tolerance_mm)
    count = int(abs(0.5 * turn * arc.radius_mm) / sqrt(inner)) if inner > 0 else 0
    for k in range(1, count):
        angle = first + turn * k / count
        point = [0.0, 0.0, 0.0]
        point[a] = arc.centre[0] + arc.radius_mm * cos(angle)
        point[b] = arc.centre[1] + arc.radius_mm * sin(angle)
        point[c] = arc.start[c] + (arc.end[c] - arc.start[c]) * k / count
        yield (point[0], point[1], point[2])
    yield arc.end


@dataclass(slots=True)
class SimulatedMove:
    """Motion of a line. target: machine mm. speed in mm/s, or seconds for the whole move if `inverse_time`."""

    motion: str
    target: Triple
    speed: float
    feed: float
    inverse_time: bool = False
    arc: SimulatedArc | None = None


@dataclass(slots=True)
class Action:
    """The actions of a checked line, beyond the modal state that it leaves. The firmware determines the `order` of
    execution.
    """

    words: Words
    modal: dict[str, str]
    feed: float
    spindle_rpm: float
    line_number: int | None = None
    tool: int | None = None
    move: SimulatedMove | None = None
    stored: Triple | None = None  # G28, G30: where to go after `move`
    offsets: Triple | None = None  # G10: new offsets of `system`; G92; G43.1 as (0, 0, z)
    system: str = ""
    dwell_s: float | None = None


@dataclass(slots=True)
class SimulatedInterpreter:
    """The parser's state. position: machine mm, where the last accepted line ends."""

    mist: bool = True
    modal: dict[str, str] = field(default_factory=lambda: dict(_START))
    coolant: set[str] = field(default_factory=set)
    feed: float = 0.0
    spindle_rpm: float = 0.0
    tool: int = 0
    position: Triple = ZERO
    stored: dict[str, Triple] = field(default_factory=lambda: dict.fromkeys((*SYSTEMS, "G28", "G30"), ZERO))
    g92: Triple = ZERO
    tool_length: float = 0.0
    offset: Triple = ZERO

    def reset(self) -> None:
        """Begin as after Ctrl-X: G92, G43.1 and modal state are gone; values in the EEPROM stay."""
        self.modal = dict(_START)
        self.coolant.clear()
        self.feed = self.spindle_rpm = self.tool_length = 0.0
        self.tool = 0
        self.g92 = ZERO
        self.refresh()

    def refresh(self) -> None:
        """Compute the offset of work coordinates (WCO) after a change."""
        wcs = self.stored[self.modal["wcs"]]
        self.offset = (wcs[0] + self.g92[0], wcs[1] + self.g92[1], wcs[2] + self.g92[2] + self.tool_length)

    # -- checks ----------------------------------------------------------------------------------------------------
    def read(self, code: bytes, *, jog: bool = False) -> Action:
        """Check one line; raises GcodeError and changes nothing."""
        words = read_words(code, mist=self.mist)
        values = words.values
        modal = {**self.modal, **{g: c for g, c in words.commands.items() if g in _START}}
        if jog:
            modal["motion"], modal["feed-mode"] = "G1", "G94"
        axes = words.axes
        if axes and not words.axis_command:
            words.axis_command = "motion"
        if values.get("N", 0.0) > _MOST_N:
            raise GcodeError(27)
        scale = INCH_MM if modal["units"] == "G20" else 1.0
        unused = set(values) - set("NF" if jog else "NFST")
        action = Action(words, modal, self._feed(words, modal, scale, jog=jog), values.get("S", self.spindle_rpm))
        if "N" in values:
            action.line_number = int(values["N"])
        if "T" in values:
            action.tool = int(values["T"])
        if words.non_modal == "G4":
            if "P" not in values:
                raise GcodeError(28)
            action.dwell_s = values["P"]
            unused.discard("P")
        given = {a: values[a] * scale for a in axes}
        if words.axis_command == "tool-length":
            if modal["tool-length"] == "G43.1":
                if axes != "Z":
                    raise GcodeError(37)
                action.offsets = (0.0, 0.0, given["Z"])
            else:
                action.offsets = ZERO
        wcs = self.stored[modal["wcs"]]
        target = self._run_non_modal(action, given, wcs, unused)
        self._run_motion(action, target, scale, unused, jog=jog)
        if words.axis_command:
            unused -= set("XYZ")
        if unused:
            raise GcodeError(36)
        return action

    def _feed(self, words: Words, modal: dict[str, str], scale: float, *, jog: bool) -> float:
        """Return the feed after the line: mm/min, or 1/min under G93; 0: undefined."""
        given = words.values.get("F")
        if jog:
            if given is None:
                raise GcodeError(22)
            return given * scale
        if modal["feed-mode"] == "G93":
            if words.axis_command == "motion" and modal["motion"] not in ("G80", "G0") and given is None:
                raise GcodeError(22)
            return given or 0.0
        if self.modal["feed-mode"] == "G94":
            return self.feed if given is None else given * scale
        return given or 0.0

    def _run_non_modal(self, action: Action, given: dict[str, float], wcs: Triple, unused: set[str]) -> Triple:
        """Run G10, G28, G30, G53, G92; return the target of any motion."""
        words, command = action.words, action.words.non_modal
        values = words.values
        if command == "G10":
            self._run_g10(action, given, unused)
            return self.position
        if command == "G92":
            if not given:
                raise GcodeError(26)
            tlo = (0.0, 0.0, self.tool_length)
            action.offsets = _triple(
                self.position[i] - wcs[i] - tlo[i] - given[a] if a in given else self.g92[i]
                for i, a in enumerate("XYZ")
            )
            return self.position
        target = self.position
        if given and words.axis_command != "tool-length":
            target = self._target(action, given, wcs)
        if command in ("G28", "G30"):
            if given:
                action.stored = _triple(
                    self.stored[command][i] if a in values else self.position[i] for i, a in enumerate("XYZ")
                )
            else:
                action.stored = self.stored[command]
                words.axis_command = ""
        if command == "G53" and action.modal["motion"] not in ("G0", "G1"):
            raise GcodeError(30)
        return target

    def _target(self, action: Action, given: dict[str, float], wcs: Triple) -> Triple:
        if action.words.non_modal == "G53":
            base = ZERO
        elif action.modal["distance"] == "G91":
            base = self.position
        else:
            base = (wcs[0] + self.g92[0], wcs[1] + self.g92[1], wcs[2] + self.g92[2] + self.tool_length)
        return _triple(base[i] + given[a] if a in given else self.position[i] for i, a in enumerate("XYZ"))

    def _run_g10(self, action: Action, given: dict[str, float], unused: set[str]) -> None:
        values = action.words.values
        if not given:
            raise GcodeError(26)
        if "P" not in values or "L" not in values:
            raise GcodeError(28)
        number, kind = int(values["P"]), int(values["L"])
        if number > len(SYSTEMS):
            raise GcodeError(29)
        if kind not in (2, 20) or (kind == 2 and "R" in values):
            raise GcodeError(20)
        unused -= {"P", "L"}
        action.system = SYSTEMS[number - 1] if number else action.modal["wcs"]
        old = self.stored[action.system]
        tlo = (0.0, 0.0, self.tool_length)
        here = _triple(self.position[i] - self.g92[i] - tlo[i] for i in range(3))
        action.offsets = _triple(
            (here[i] - given[a] if kind == 20 else given[a]) if a in given else old[i] for i, a in enumerate("XYZ")
        )

    def _run_motion(self, action: Action, target: Triple, scale: float, unused: set[str], *, jog: bool) -> None:
        words, modal, axes = action.words, action.modal, action.words.axes
        motion = modal["motion"]
        if motion == "G80":
            if axes:
                raise GcodeError(31)
            return
        if words.non_modal in ("G28", "G30"):
            if axes:
                action.move = SimulatedMove("G0", target, 0.0, 0.0)
            return
        if words.axis_command != "motion":
            return
        inverse = modal["feed-mode"] == "G93"
        if motion != "G0" and action.feed == 0.0:
            raise GcodeError(22)
        move = SimulatedMove(motion, target, action.feed / 60.0, action.feed, inverse)
        if motion in ("G0", "G1"):
            if not axes:
                words.axis_command = ""
                return
        elif motion in ("G2", "G3"):
            move.arc = self._arc(words, modal, target, scale, unused)
        else:
            if not axes:
                raise GcodeError(26)
            if target == self.position:
                raise GcodeError(33)
        action.move = move

    def _arc(self, words: Words, modal: dict[str, str], target: Triple, scale: float, unused: set[str]) -> SimulatedArc:
        plane = PLANES[modal["plane"]]
        clockwise = modal["motion"] == "G2"
        if not words.axes:
            raise GcodeError(26)
        if not any("XYZ"[i] in words.axes for i in plane[:2]):
            raise GcodeError(32)
        if "R" in words.values:
            unused.discard("R")
            return arc_from_radius(self.position, target, words.values["R"] * scale, plane, clockwise)
        names = ("IJK"[plane[0]], "IJK"[plane[1]])
        if not any(n in words.values for n in names):
            raise GcodeError(35)
        unused -= set("IJK")
        offsets = (words.values.get(names[0], 0.0) * scale, words.values.get(names[1], 0.0) * scale)
        return arc_from_offsets(self.position, target, offsets, plane, clockwise)


def _triple(values: Iterable[float]) -> Triple:
    x, y, z = values
    return (x, y, z)
