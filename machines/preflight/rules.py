"""What a scan's figures mean for the person: modes relied on without being said, warnings, and the last refusals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite

from machines.errors import ProgramRefusedError
from machines.gcode import tally
from machines.gcode.dialects import Dialect
from machines.preflight.limits import MillLimits
from machines.preflight.preflight import Bounds

_FRAMES = ("G54", "G55", "G56", "G57", "G58", "G59", "shifted", "machine")
_AXES = "XYZ"

Events = Sequence[Sequence[int]]
STARVED_SHARE = 0.1  # of the time, from which waiting for lines is worth a word

_WORDS = (
    (tally.SPINDLE_OFF, "cuts with the spindle off or at S0"),
    (tally.BLIND_CUT, "cuts before X, Y and Z are all given: it starts wherever the tool then stands"),
    (tally.BLIND_RELATIVE, "moves relatively (G91) from a place the program does not tell; extents leave it out"),
    (tally.FRAME_MOVED, "moves the program's own frame (G10, G92, G43.1 or a tool's offset); "
                        "extents from there on are not held against the work zero"),
    (tally.OTHER_OFFSET, "works in another offset than G54 (G15 H1); see that it is set"),
    (tally.SETTINGS_WRITTEN, "writes the controller's EEPROM (G10, G28.1, G30.1); it is sent alone, with a pause"),
    (tally.STOPS, "stops for the operator (M0, M1) until cycle start"),
    (tally.PLACE_UNKNOWN, "goes to a place only the controller knows (G28, G30, G38); time and extents leave it out"),
    (tally.MACHINE_MOVES, "moves in machine coordinates (G53), which mean something only after homing"),
)  # fmt: skip


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
                reason = (
                    f"the program goes from {name} {box.least_mm[axis]:.3f} to {box.most_mm[axis]:.3f} mm ({frame}), "
                    f"{span:.3f} mm; {limits.profile} travels {travel:g} mm: use a larger machine or a smaller part"
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
) -> Iterator[str]:
    """Return what the person should know before a start, one sentence each."""
    if not moves:
        yield "the program moves nothing"
    for slot, word in ((tally.UNITS_ASSUMED, "G20 or G21"), (tally.DISTANCE_ASSUMED, "G90 or G91")):
        if events[slot][1]:
            read = "mm (G21)" if slot == tally.UNITS_ASSUMED else "absolute (G90)"
            yield f"line {events[slot][0]}: coordinates before {word}; read as {read}, which the controller must be in"
    for slot, words in _WORDS:
        if events[slot][1] and not (slot == tally.MACHINE_MOVES and limits.homing):
            yield _at(events, slot, words)
    if events[tally.OVER_RATE][1]:
        yield _at(events, tally.OVER_RATE, "asks for more feed than an axis can go; the controller cuts slower there")
    if events[tally.MIST][1] and not dialect.mist:
        yield _at(events, tally.MIST, "M7 is error:20 on stock GRBL 1.1 (built without ENABLE_M7)")
    low, high = limits.spindle_rpm
    if spindle is not None and spindle[1] > high:
        yield f"S goes up to {spindle[1]:g} rpm, the spindle of {limits.profile} to {high:g}: it will turn slower"
    if spindle is not None and 0 < spindle[0] < low:
        yield f"S goes down to {spindle[0]:g} rpm, the spindle of {limits.profile} to {low:g}: it will turn faster"
    if dialect.tapes and dialect.numbered and not events[tally.NUMBERED][1]:
        yield "the program has no sequence numbers (N): after an interruption it cannot be restarted in the middle"
    if not ends:
        yield "the program has no end (M2 or M30): the spindle stays as the last line leaves it"


def warn_of_starving(
    limits: MillLimits, feeds: tuple[float, float] | None, *, path_length_mm: float, time_s: float, starved_s: float
) -> Iterator[str]:
    """Yield what the link carries of the feed, where the mill stands for much of its time waiting for lines."""
    if feeds is not None and starved_s >= STARVED_SHARE * time_s > 0:
        wire = "" if limits.bytes_per_s is None else f" and {limits.bytes_per_s:.0f} bytes"
        yield (
            f"the link is too slow: F{feeds[1]:g} is asked for, and {limits.lines_per_s:g} lines{wire} a second carry "
            f"F{60 * path_length_mm / time_s:.0f} on average; the mill stands waiting for lines "
            f"{100 * starved_s / time_s:.0f} % of the time. A faster link helps, or the control's own memory"
        )


def require_spindle(dialect: Dialect, limits: MillLimits, spindle: tuple[float, float] | None) -> None:
    """Refuse a program for a control that faults on one of its speeds."""
    low, high = limits.spindle_rpm
    if dialect.spindle_first and spindle is not None and not (low <= spindle[0] and spindle[1] <= high):
        reason = f"S{spindle[0]:g} to S{spindle[1]:g}: {dialect.title} takes {low:g} to {high:g} rpm; change S"
        raise ProgramRefusedError(0, "", reason)


def _at(events: Events, slot: int, words: str) -> str:
    line, count = events[slot]
    more = f" (and {count - 1} more)" if count > 1 else ""
    return f"line {line}{more}: {words}"
