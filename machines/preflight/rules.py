"""What a scan's figures mean for the person: modes relied on without being said, warnings, and the last refusals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite

from machines.errors import ProgramRefusedError
from machines.gcode import tally
from machines.gcode.dialects import Dialect
from machines.preflight.limits import MillLimits
from machines.preflight.preflight import Bounds
from phrases.phrase import Phrase

_FRAMES = ("G54", "G55", "G56", "G57", "G58", "G59", "shifted", "machine")
_AXES = "XYZ"

Events = Sequence[Sequence[int]]
STARVED_SHARE = 0.1  # of the time, from which waiting for lines is worth a word

_WORDS = (
    (tally.SPINDLE_OFF, Phrase("cuts with the spindle off or at S0")),
    (tally.BLIND_CUT, Phrase("cuts before X, Y and Z are all given: it starts wherever the tool then stands")),
    (
        tally.BLIND_RELATIVE,
        Phrase("moves relatively (G91) from a place the program does not tell; extents leave it out"),
    ),
    (
        tally.FRAME_MOVED,
        Phrase(
            "moves the program's own frame (G10, G92, G43.1 or a tool's offset); "
            "extents from there on are not held against the work zero"
        ),
    ),
    (tally.OTHER_OFFSET, Phrase("works in another offset than G54 (G15 H1); see that it is set")),
    (
        tally.SETTINGS_WRITTEN,
        Phrase("writes the controller's EEPROM (G10, G28.1, G30.1); it is sent alone, with a pause"),
    ),
    (tally.STOPS, Phrase("stops for the operator (M0, M1) until cycle start")),
    (
        tally.PLACE_UNKNOWN,
        Phrase("goes to a place only the controller knows (G28, G30, G38); time and extents leave it out"),
    ),
    (tally.MACHINE_MOVES, Phrase("moves in machine coordinates (G53), which mean something only after homing")),
)


def list_assumed_modes(events: Events) -> tuple[str, ...]:
    """Return modes in force at the first coordinates although the program has not said them."""
    pairs = ((tally.UNITS_ASSUMED, "G21"), (tally.DISTANCE_ASSUMED, "G90"))
    return tuple(word for slot, word in pairs if events[slot][1])


def bounds_by_frame(rows: Sequence[Sequence[float]]) -> dict[str, Bounds]:
    """Return boxes of the frames that were used; infinite ends are axes that never were at a known place."""
    found = {}
    for name, row in zip(_FRAMES, rows, strict=True):
        ends = [value if isfinite(value) else None for value in map(float, row)]
        if any(value is not None for value in ends):
            found[name] = Bounds((ends[0], ends[1], ends[2]), (ends[3], ends[4], ends[5]))
    return found


def require_travel(boxes: dict[str, Bounds], limits: MillLimits) -> None:
    """Refuse a program that is larger than the machine, wherever its zero may be put."""
    for frame, box in boxes.items():
        for axis, name in enumerate(_AXES):
            span, travel = box.span_mm(axis), limits.travel_mm[axis]
            if span > travel + 1e-6:
                reason = Phrase(
                    "the program goes from {axis} {least_mm:.3f} to {most_mm:.3f} mm ({frame}), {span_mm:.3f} mm; "
                    "{machine} travels {travel_mm:g} mm: use a larger machine or a smaller part",
                    axis=name,
                    least_mm=box.least_mm[axis],
                    most_mm=box.most_mm[axis],
                    frame=frame,
                    span_mm=span,
                    machine=limits.profile,
                    travel_mm=travel,
                )
                raise ProgramRefusedError(0, "", reason)


def warnings(
    events: Events,
    *,
    dialect: Dialect,
    limits: MillLimits,
    spindle: tuple[float, float] | None,
    ends: bool,
    moves: bool,
) -> Iterator[Phrase]:
    """Return what the person should know before a start, one sentence each."""
    if not moves:
        yield Phrase("the program moves nothing")
    if events[tally.UNITS_ASSUMED][1]:
        yield Phrase(
            "line {line}: coordinates before G20 or G21; read as mm (G21), which the controller must be in",
            line=events[tally.UNITS_ASSUMED][0],
        )
    if events[tally.DISTANCE_ASSUMED][1]:
        yield Phrase(
            "line {line}: coordinates before G90 or G91; read as absolute (G90), which the controller must be in",
            line=events[tally.DISTANCE_ASSUMED][0],
        )
    for slot, words in _WORDS:
        if events[slot][1] and not (slot == tally.MACHINE_MOVES and limits.homing):
            yield _at(events, slot, words)
    if events[tally.OVER_RATE][1]:
        words = Phrase("asks for more feed than an axis can go; the controller cuts slower there")
        yield _at(events, tally.OVER_RATE, words)
    if events[tally.MIST][1] and not dialect.mist and not limits.mist:
        yield _at(events, tally.MIST, Phrase("M7 is error:20 on stock GRBL 1.1 (built without ENABLE_M7)"))
    low, high = limits.spindle_rpm
    if spindle is not None and spindle[1] > high:
        yield Phrase(
            "S goes up to {most_rpm:g} rpm, the spindle of {machine} to {limit_rpm:g}: it will turn slower",
            most_rpm=spindle[1],
            machine=limits.profile,
            limit_rpm=high,
        )
    if spindle is not None and 0 < spindle[0] < low:
        yield Phrase(
            "S goes down to {least_rpm:g} rpm, the spindle of {machine} to {limit_rpm:g}: it will turn faster",
            least_rpm=spindle[0],
            machine=limits.profile,
            limit_rpm=low,
        )
    if dialect.tapes and dialect.numbered and not events[tally.NUMBERED][1]:
        yield Phrase(
            "the program has no sequence numbers (N): after an interruption it cannot be restarted in the middle"
        )
    if not ends:
        yield Phrase("the program has no end (M2 or M30): the spindle stays as the last line leaves it")


def warn_of_starving(
    limits: MillLimits, feeds: tuple[float, float] | None, *, path_length_mm: float, time_s: float, starved_s: float
) -> Iterator[Phrase]:
    """Yield what the link carries of the feed, where the mill stands for much of its time waiting for lines."""
    if feeds is not None and starved_s >= STARVED_SHARE * time_s > 0:
        lines = Phrase("{count:g} lines", count=limits.lines_per_s)
        carried = lines
        if limits.bytes_per_s is not None:
            carried = Phrase("{lines} and {count:.0f} bytes", lines=lines, count=limits.bytes_per_s)
        yield Phrase(
            "the link is too slow: F{feed_mm_per_min:g} is asked for, and {carried} a second carry "
            "F{average_mm_per_min:.0f} on average; the mill stands waiting for lines {percent:.0f} % of the time. "
            "A faster link helps, or the control's own memory",
            feed_mm_per_min=feeds[1],
            carried=carried,
            average_mm_per_min=60 * path_length_mm / time_s,
            percent=100 * starved_s / time_s,
        )


def require_spindle(dialect: Dialect, limits: MillLimits, spindle: tuple[float, float] | None) -> None:
    """Refuse a program for a control that faults on one of its speeds."""
    low, high = limits.spindle_rpm
    if dialect.spindle_first and spindle is not None and not (low <= spindle[0] and spindle[1] <= high):
        reason = Phrase(
            "S{least_rpm:g} to S{most_rpm:g}: {control} takes {low_rpm:g} to {high_rpm:g} rpm; change S",
            least_rpm=spindle[0],
            most_rpm=spindle[1],
            control=dialect.title,
            low_rpm=low,
            high_rpm=high,
        )
        raise ProgramRefusedError(0, "", reason)


def _at(events: Events, slot: int, words: Phrase) -> Phrase:
    line, count = events[slot]
    if count > 1:
        return Phrase("line {line} (and {count} more): {words}", line=line, count=count - 1, words=words)
    return Phrase("line {line}: {words}", line=line, words=words)
