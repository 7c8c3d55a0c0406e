"""The rules that a program must keep on a mill, in one table: for `check`, the end of a job, and every start.

Each row judges one `Reading` of the whole program. A broken rule means one of three things:
    REFUSE  the program is never sent to a mill
    FAULT   `check` and a job fail; before a start it is a warning, as the author of a program may intend it. Then the
            way in is judged once more, from where the tool stands.
    WARN    a person should know it
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import hypot, isfinite, isnan

from machines.errors import ProgramRefusedError
from machines.gcode import tally
from machines.gcode.dialects import DIALECTS, Dialect
from machines.preflight.preflight import Bounds, Finding, MillLimits
from machines.preflight.way_in import WAY_IN, Motion, find_risk, is_raised
from phrases.phrase import Phrase

_FRAMES = ("G54", "G55", "G56", "G57", "G58", "G59", "shifted", "machine")
_AXES = "XYZ"
_ROUNDING_MM = 1e-6
_LONG_PAUSE_S = 1000.0  # a warm-up of an hour has four steps

Events = Sequence[Sequence[int]]
NO_EVENTS: Events = ((0, 0),) * tally.EVENTS
STARVED_SHARE = 0.1  # share of the time from which waiting for lines is worth a warning


class Severity(StrEnum):
    """What a broken rule means; see above."""

    REFUSE = "refuse"
    FAULT = "fault"
    WARN = "warn"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A whole program as it was read: what the rules look at.

    events    : first line and count of each, by `machines.gcode.tally`
    boxes     : of `find_boxes`
    feeds_mm_per_min, spindle_rpm : least and most, of cuts and of a spindle that turns; None without
    motions   : how many steps move anything
    ends, spindle_left_on : by the last line
    way_in    : the first motions, until X, Y and Z are given
    last_z_mm : where the last motion ends, in the work frame; nan: in machine coordinates, at last_machine_z_mm
    pause_s   : the longest
    lines     : that are sent; starved_s: of time_s, how long the mill waits for them
    """

    limits: MillLimits
    events: Events = NO_EVENTS
    boxes: dict[str, Bounds]
    feeds_mm_per_min: tuple[float, float] | None
    spindle_rpm: tuple[float, float] | None
    motions: int
    ends: bool
    spindle_left_on: bool
    way_in: tuple[Motion, ...]
    last_z_mm: float
    last_machine_z_mm: float
    pause_s: float
    path_length_mm: float
    time_s: float
    lines: int = 0
    starved_s: float = 0.0

    @property
    def dialect(self) -> Dialect | None:
        """Of G-code; None for another language."""
        return DIALECTS.get(self.limits.dialect)


@dataclass(frozen=True, slots=True)
class Rule:
    """One row: its name, the severity of a finding, and `judge`, which returns the finding."""

    code: str
    severity: Severity
    judge: Callable[[Reading], Phrase | None]


def judge_program(reading: Reading) -> tuple[Finding, ...]:
    """Return a finding for each of RULES that the program breaks; ProgramRefusedError at the first of REFUSE."""
    found = []
    for rule in RULES:
        if (words := rule.judge(reading)) is None:
            continue
        if rule.severity is Severity.REFUSE:
            raise ProgramRefusedError(0, "", words)
        found.append(Finding(rule.code, rule.severity is Severity.FAULT, words))
    return tuple(found)


def list_assumed_modes(events: Events) -> tuple[str, ...]:
    """Return modes that are in force at the first coordinates although the program has not set them."""
    pairs = ((tally.UNITS_ASSUMED, "G21"), (tally.DISTANCE_ASSUMED, "G90"))
    return tuple(word for slot, word in pairs if events[slot][1])


def find_boxes(rows: Sequence[Sequence[float]]) -> dict[str, Bounds]:
    """Return boxes of the frames in use; infinite ends are axes that were never at a known place."""
    found = {}
    for name, row in zip(_FRAMES, rows, strict=True):
        ends = [value if isfinite(value) else None for value in map(float, row)]
        if any(value is not None for value in ends):
            found[name] = Bounds((ends[0], ends[1], ends[2]), (ends[3], ends[4], ends[5]))
    return found


def _judge_event(slot: int, words: Phrase) -> Callable[[Reading], Phrase | None]:
    return lambda reading: _at(reading.events, slot, words) if reading.events[slot][1] else None


def _judge_travel(reading: Reading) -> Phrase | None:
    """Refuse a program that is larger than the travel: no work zero makes it fit."""
    limits = reading.limits
    for frame, box in reading.boxes.items():
        for axis, name in enumerate(_AXES):
            span, travel = box.span_mm(axis), limits.travel_mm[axis]
            if span > travel + _ROUNDING_MM:
                return Phrase(
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
    return None


def _judge_spindle_of_control(reading: Reading) -> Phrase | None:
    """Refuse a speed at which the control itself would fault."""
    (low, high), spindle, dialect = reading.limits.spindle_rpm, reading.spindle_rpm, reading.dialect
    if dialect is None or not dialect.spindle_first or spindle is None or (low <= spindle[0] and spindle[1] <= high):
        return None
    return Phrase(
        "S{least_rpm:g} to S{most_rpm:g}: {control} takes {low_rpm:g} to {high_rpm:g} rpm; change S",
        least_rpm=spindle[0],
        most_rpm=spindle[1],
        control=dialect.title,
        low_rpm=low,
        high_rpm=high,
    )


def _judge_motion(reading: Reading) -> Phrase | None:
    return None if reading.motions else Phrase("the program moves nothing")


def _judge_way_in(reading: Reading) -> Phrase | None:
    limits = reading.limits
    return find_risk(reading.way_in, safe_z_mm=limits.safe_z_mm, top_z_mm=limits.top_z_mm)


def _judge_way_out(reading: Reading) -> Phrase | None:
    """Require that the tool ends at a safe height: the next program, or a jog, goes across from there."""
    limits, z_mm, machine_z_mm = reading.limits, reading.last_z_mm, reading.last_machine_z_mm
    if not reading.motions or z_mm >= limits.safe_z_mm - _ROUNDING_MM:
        return None
    if not isnan(z_mm):
        return Phrase(
            "the program leaves the tool at Z{z_mm:g}, below the safe height Z{safe_z_mm:g}; end it with a move up",
            z_mm=z_mm,
            safe_z_mm=limits.safe_z_mm,
        )
    if is_raised(machine_z_mm, limits.top_z_mm):
        return None
    return Phrase(
        "the program leaves the tool at an unknown height; end it with a move up to Z{safe_z_mm:g} or higher",
        safe_z_mm=limits.safe_z_mm,
    )


def _judge_offset(reading: Reading) -> Phrase | None:
    dialect, wanted = reading.dialect, reading.limits.work_offset
    others = [n for n, frame in enumerate(_FRAMES[:6], 1) if frame in reading.boxes and n != wanted]
    if not others:
        return None
    names = [f"G{53 + n}" if dialect is None else dialect.name_offset(n) for n in (*others, wanted)]
    return Phrase(
        "works in the offset {other}, but the job and the mill use {wanted} (machine.work_offset): its zero may be "
        "anywhere",
        other=", ".join(names[:-1]),
        wanted=names[-1],
    )


def _judge_feed(reading: Reading) -> Phrase | None:
    limits, feeds = reading.limits, reading.feeds_mm_per_min
    fastest = hypot(*limits.max_rate_mm_per_min)
    if feeds is None or feeds[1] <= fastest + 1:
        return None
    return Phrase(
        "F goes up to {most_mm_per_min:g} mm/min, but {machine} moves at most {limit_mm_per_min:.0f} mm/min in any "
        "direction: is this the feed that you meant?",
        most_mm_per_min=feeds[1],
        machine=limits.profile,
        limit_mm_per_min=fastest,
    )


def _judge_fastest_spindle(reading: Reading) -> Phrase | None:
    limits, spindle = reading.limits, reading.spindle_rpm
    if spindle is None or spindle[1] <= limits.spindle_rpm[1]:
        return None
    return Phrase(
        "S goes up to {most_rpm:g} rpm, the spindle of {machine} to {limit_rpm:g}: it will turn slower",
        most_rpm=spindle[1],
        machine=limits.profile,
        limit_rpm=limits.spindle_rpm[1],
    )


def _judge_slowest_spindle(reading: Reading) -> Phrase | None:
    limits, spindle = reading.limits, reading.spindle_rpm
    if spindle is None or not 0 < spindle[0] < limits.spindle_rpm[0]:
        return None
    return Phrase(
        "S goes down to {least_rpm:g} rpm, the spindle of {machine} to {limit_rpm:g}: it will turn faster",
        least_rpm=spindle[0],
        machine=limits.profile,
        limit_rpm=limits.spindle_rpm[0],
    )


def _judge_end(reading: Reading) -> Phrase | None:
    if reading.dialect is None or reading.ends:
        return None
    return Phrase("the program has no end (M2 or M30): the spindle stays as the last line leaves it")


def _judge_spindle_off(reading: Reading) -> Phrase | None:
    if reading.limits.dry_pass:
        return None
    return _judge_event(tally.SPINDLE_OFF, Phrase("cuts with the spindle off or at S0"))(reading)


def _judge_spindle_left_on(reading: Reading) -> Phrase | None:
    return Phrase("the program leaves the spindle on") if reading.spindle_left_on else None


def _judge_pause(reading: Reading) -> Phrase | None:
    if reading.pause_s <= _LONG_PAUSE_S:
        return None
    return Phrase(
        "a dwell (G4) lasts {minutes:.0f} minutes: this control reads its number as {pause_s:g} seconds; did "
        "you mean milliseconds?",
        minutes=reading.pause_s / 60,
        pause_s=reading.pause_s,
    )


def _judge_machine_moves(reading: Reading) -> Phrase | None:
    words = Phrase("moves in machine coordinates (G53), which mean something only after homing")
    return None if reading.limits.homing else _judge_event(tally.MACHINE_MOVES, words)(reading)


def _judge_mist(reading: Reading) -> Phrase | None:
    if reading.dialect is None or reading.dialect.mist or reading.limits.mist:
        return None
    return _judge_event(tally.MIST, Phrase("M7 is error:20 on stock GRBL 1.1 (built without ENABLE_M7)"))(reading)


def _judge_numbers(reading: Reading) -> Phrase | None:
    dialect = reading.dialect
    if dialect is None or not dialect.tapes or not dialect.numbered or reading.events[tally.NUMBERED][1]:
        return None
    return Phrase("the program has no sequence numbers (N): after an interruption it cannot be restarted in the middle")


def _judge_link(reading: Reading) -> Phrase | None:
    limits, feeds = reading.limits, reading.feeds_mm_per_min
    if feeds is None:
        return None
    return describe_slow_link(
        limits.lines_per_s,
        limits.bytes_per_s,
        feed_mm_per_min=feeds[1],
        lines=reading.lines,
        path_length_mm=reading.path_length_mm,
        time_s=reading.time_s,
        starved_s=reading.starved_s,
    )


def describe_slow_link(
    lines_per_s: float,
    bytes_per_s: float | None,
    *,
    feed_mm_per_min: float,
    lines: int,
    path_length_mm: float,
    time_s: float,
    starved_s: float,
) -> Phrase | None:
    """Return the feed that the link can carry, and remedies, if the mill waits for lines for much of its time."""
    if not path_length_mm > 0 or not starved_s >= STARVED_SHARE * time_s > 0:
        return None
    carried = Phrase("{count:g} lines", count=lines_per_s)
    if bytes_per_s is not None:
        carried = Phrase("{lines} and {count:.0f} bytes", lines=carried, count=bytes_per_s)
    return Phrase(
        "the link is too slow: the program asks for F{feed_mm_per_min:g}, but {carried} a second carry "
        "F{average_mm_per_min:.0f} on average; the mill waits for lines {percent:.0f} % of the time. {need_per_s:.0f} "
        "lines a second would be enough, and so would the control's own memory; otherwise ask for the feed that the "
        "link carries and slow the spindle in proportion, or the cutter rubs",
        feed_mm_per_min=feed_mm_per_min,
        carried=carried,
        average_mm_per_min=60 * path_length_mm / time_s,
        percent=100 * starved_s / time_s,
        need_per_s=lines / max(time_s - starved_s, 1.0),
    )


def _at(events: Events, slot: int, words: Phrase) -> Phrase:
    line, count = events[slot]
    if count > 1:
        return Phrase("line {line} (and {count} more): {words}", line=line, count=count - 1, words=words)
    return Phrase("line {line}: {words}", line=line, words=words)


def _judge_units(reading: Reading) -> Phrase | None:
    if not reading.events[tally.UNITS_ASSUMED][1]:
        return None
    return Phrase(
        "line {line}: coordinates before G20 or G21; read as mm (G21), which the controller must be in",
        line=reading.events[tally.UNITS_ASSUMED][0],
    )


def _judge_distance(reading: Reading) -> Phrase | None:
    if not reading.events[tally.DISTANCE_ASSUMED][1]:
        return None
    return Phrase(
        "line {line}: coordinates before G90 or G91; read as absolute (G90), which the controller must be in",
        line=reading.events[tally.DISTANCE_ASSUMED][0],
    )


_REFUSE, _FAULT, _WARN = Severity.REFUSE, Severity.FAULT, Severity.WARN
RULES = (
    Rule("travel", _REFUSE, _judge_travel),
    Rule("spindle-of-control", _REFUSE, _judge_spindle_of_control),
    Rule("motion", _FAULT, _judge_motion),
    Rule("units", _FAULT, _judge_units),
    Rule("distance", _FAULT, _judge_distance),
    Rule(WAY_IN, _FAULT, _judge_way_in),
    Rule("way-out", _FAULT, _judge_way_out),
    Rule("offset", _FAULT, _judge_offset),
    Rule("feed", _FAULT, _judge_feed),
    Rule("spindle-fast", _FAULT, _judge_fastest_spindle),
    Rule("spindle-slow", _FAULT, _judge_slowest_spindle),
    Rule("spindle-off", _FAULT, _judge_spindle_off),
    Rule(
        "blind-cut",
        _FAULT,
        _judge_event(
            tally.BLIND_CUT, Phrase("cuts before X, Y and Z are all given: it starts wherever the tool then stands")
        ),
    ),
    Rule(
        "blind-relative",
        _FAULT,
        _judge_event(
            tally.BLIND_RELATIVE,
            Phrase("moves relatively (G91) from a place that the program does not state; extents leave it out"),
        ),
    ),
    Rule(
        "frame",
        _FAULT,
        _judge_event(
            tally.FRAME_MOVED,
            Phrase(
                "moves the program's own frame (G10, G92, G43.1 or a tool's offset); extents from there on are not "
                "checked against the work zero"
            ),
        ),
    ),
    Rule("end", _FAULT, _judge_end),
    Rule("spindle-left-on", _FAULT, _judge_spindle_left_on),
    Rule(
        "settings",
        _WARN,
        _judge_event(
            tally.SETTINGS_WRITTEN,
            Phrase("writes the controller's EEPROM (G10, G28.1, G30.1); it is sent alone, with a pause"),
        ),
    ),
    Rule("stops", _WARN, _judge_event(tally.STOPS, Phrase("stops for the operator (M0, M1) until cycle start"))),
    Rule(
        "home",
        _WARN,
        _judge_event(
            tally.PLACE_UNKNOWN,
            Phrase(
                "goes to a place that only the controller knows (G28, G30, G38); time and extents leave the move out"
            ),
        ),
    ),
    Rule("machine", _WARN, _judge_machine_moves),
    Rule("pause", _WARN, _judge_pause),
    Rule(
        "rate",
        _WARN,
        _judge_event(
            tally.OVER_RATE, Phrase("asks for a higher feed than an axis can reach; the controller cuts slower there")
        ),
    ),
    Rule("mist", _WARN, _judge_mist),
    Rule("numbers", _WARN, _judge_numbers),
    Rule("link", _WARN, _judge_link),
)
"""In the order in which a person reads them."""
