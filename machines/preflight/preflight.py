"""The results of a program's pre-flight, as plain data stored as JSON: extents, feeds, time, index, warnings.

Also the limits against which it is checked: the profile's figures, or the controller's own if it has reported them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from machines.driver import Triple
from machines.gcode.program import ProgramIndex
from machines.grbl.settings import ControllerSettings
from machines.profile import MachineProfile
from phrases.phrase import Phrase, phrases_in, restore


@dataclass(frozen=True, slots=True)
class Bounds:
    """Smallest box around all programmed points, mm; None for an axis that was never at a known place."""

    least_mm: tuple[float | None, float | None, float | None]
    most_mm: tuple[float | None, float | None, float | None]

    def span_mm(self, axis: int) -> float:
        least, most = self.least_mm[axis], self.most_mm[axis]
        return 0.0 if least is None or most is None else most - least


class Finding(NamedTuple):
    """A finding for a person: the name of the rule in `machines.preflight.rules`, and the sentence.

    is_fault : it makes a job, and `check`, fail
    """

    code: str
    is_fault: bool
    words: Phrase


@dataclass(frozen=True, slots=True, kw_only=True)
class Preflight:
    """The pre-flight of one program, read whole.

    blocks            : lines that are sent (neither blank nor only a comment)
    bounds_mm         : box in the first frame of `bounds_by_frame`, which has all: "G54" ... "machine" (G53), "shifted"
                        (after G92, G10 or G43.1 in the program: not comparable with the work zero)
    feeds_mm_per_min  : slowest and fastest feed of cutting moves; None without one
    spindle_rpm       : lowest and highest speed while the spindle turns; None if it never does
    time_s            : estimate for the mill's kinematics and link, without operator stops
    timeline          : when lines are executed in that time (machines.preflight.timeline)
    ends              : M2 or M30 was found
    mist_line         : the first line with M7, 0 if there is none: not every controller is built with it
    assumed           : modes on which it relies without stating them, e.g. ("G21", "G90"): check against $G before a
    start
    """

    sha256: str
    bytes: int
    lines: int
    blocks: int
    dialect: str
    profile: str
    bounds_mm: Bounds | None
    bounds_by_frame: dict[str, Bounds] = field(default_factory=dict)
    feeds_mm_per_min: tuple[float, float] | None
    spindle_rpm: tuple[float, float] | None
    path_length_mm: float
    time_s: float
    timeline: tuple[tuple[int, float], ...] = ()
    ends: bool
    mist_line: int = 0
    assumed: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    index: ProgramIndex

    @property
    def warnings(self) -> tuple[Phrase, ...]:
        """Return all findings in words, faults first, for a person to read before a start."""
        return tuple(one.words for one in sorted(self.findings, key=lambda one: not one.is_fault))

    @property
    def faults(self) -> tuple[Phrase, ...]:
        return tuple(one.words for one in self.findings if one.is_fault)

    def to_json(self) -> str:
        plain = {name: getattr(self, name) for name in self.__slots__} | {
            "bounds_mm": _bounds_to_plain(self.bounds_mm),
            "bounds_by_frame": {name: _bounds_to_plain(box) for name, box in self.bounds_by_frame.items()},
            "index": self.index.to_dict(),
            "findings": [list(one) for one in self.findings],
            "phrases": phrases_in(self.warnings),
        }
        return json.dumps(plain, separators=(",", ":"), allow_nan=False)

    @staticmethod
    def from_json(text: str) -> Preflight:
        values = json.loads(text)
        findings = restore(values["findings"], values.pop("phrases", {}))
        feeds, spindle = values["feeds_mm_per_min"], values["spindle_rpm"]
        frames = values["bounds_by_frame"].items()
        values |= {
            "bounds_mm": _bounds_from_plain(values["bounds_mm"]),
            "bounds_by_frame": {name: box for name, plain in frames if (box := _bounds_from_plain(plain))},
            "feeds_mm_per_min": (feeds[0], feeds[1]) if feeds else None,
            "spindle_rpm": (spindle[0], spindle[1]) if spindle else None,
            "assumed": tuple(values["assumed"]),
            "timeline": tuple((line, at_s) for line, at_s in values.get("timeline", ())),
            "findings": tuple(Finding(*one) for one in findings),
            "index": ProgramIndex.from_dict(values["index"]),
        }
        return Preflight(**values)


def _bounds_to_plain(bounds: Bounds | None) -> list[list[float | None]] | None:
    return None if bounds is None else [list(bounds.least_mm), list(bounds.most_mm)]


def _bounds_from_plain(plain: Any) -> Bounds | None:
    if plain is None:
        return None
    (a, b, c), (d, e, f) = plain
    return Bounds((a, b, c), (d, e, f))


AT_PRESENT_ZERO = "at the present work zero"
"""The beginning of a warning that holds until the work zero is set again."""

_AXES = "XYZ"


@dataclass(frozen=True, slots=True, kw_only=True)
class MillLimits:
    """Travel, speeds and link of one mill; part of the cache key of a pre-flight.

    bytes_per_s : of the wire; None if blocks do not go over a paced serial line
    homing : machine coordinates mean something
    safe_z_mm, top_z_mm, work_offset : as in `machines.profile.MachineProfile`
    mist   : the controller is built with M7; None if it has not reported that
    dry_pass : the program is one of a dry pass, which moves with the spindle off
    """

    profile: str
    dialect: str
    travel_mm: Triple
    max_rate_mm_per_min: Triple
    acceleration_mm_per_s2: Triple
    junction_deviation_mm: float
    planner_blocks: int
    lines_per_s: float
    bytes_per_s: float | None
    spindle_rpm: tuple[float, float]
    safe_z_mm: float
    homing: bool = False
    top_z_mm: float | None = None
    work_offset: int = 1
    mist: bool | None = None
    dry_pass: bool = False

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> MillLimits:
        values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in data.items()}
        return MillLimits(**values)


def limits_of(
    profile: MachineProfile, settings: ControllerSettings | None = None, *, dry_pass: bool = False
) -> MillLimits:
    """Return the profile's figures, replaced by the controller's own as far as it has reported them."""
    reported = settings or ControllerSettings()
    fastest = reported.number(30)
    slowest = reported.number(31)
    spindle = (slowest or 0.0, fastest) if fastest else profile.spindle_rpm
    return MillLimits(
        profile=profile.name,
        dialect=profile.dialect,
        travel_mm=_usable(reported.travel_mm) or profile.travel_mm,
        max_rate_mm_per_min=_usable(reported.max_rate_mm_per_min) or profile.max_rate_mm_per_min,
        acceleration_mm_per_s2=_usable(reported.acceleration_mm_per_s2) or profile.acceleration_mm_per_s2,
        junction_deviation_mm=reported.number(11) or profile.junction_deviation_mm,
        planner_blocks=max(2, reported.planner_blocks or profile.planner_blocks),
        lines_per_s=profile.lines_per_s,
        bytes_per_s=None if profile.link.driver in ("roland-usb", "none") else profile.link.wire_bytes_per_s,
        spindle_rpm=spindle,
        safe_z_mm=profile.safe_z_mm,
        homing=profile.homing,
        top_z_mm=profile.top_z_mm,
        work_offset=profile.work_offset,
        mist=reported.mist,
        dry_pass=dry_pass,
    )


def warn_at_present_zero(problem: Phrase) -> Phrase:
    """Return the warning that begins with AT_PRESENT_ZERO."""
    return Phrase("at the present work zero {problem}", problem=problem)


def _usable(triple: Triple | None) -> Triple | None:
    return triple if triple is not None and min(triple) > 0 else None


def work_zero_mm(offsets: Mapping[str, Sequence[float]], wcs: str) -> Triple | None:
    """Return the work zero in machine coordinates, from the controller's offsets; None if they lack it."""
    if wcs not in offsets:
        return None
    reported = [offsets[name] for name in (wcs, "G92", "TLO") if name in offsets]
    x, y, z = (sum(float(one[axis]) for one in reported) for axis in range(3))
    return x, y, z


def top_of_travel_mm(settings: ControllerSettings | None) -> float | None:
    """Return the highest machine Z; None if it is not known."""
    return None if settings is None or settings.reach_mm is None else settings.reach_mm[2][1]


def placement_problems(program: Preflight, settings: ControllerSettings) -> tuple[Phrase, ...]:
    """Return a sentence for each place where the program, at the controller's present offsets, leaves the machine's
    travel.

    Call it right before a start: offsets change when the work is zeroed. It is also empty if nothing can be said:
    travel or offsets are not known, or the machine has no homing.
    """
    reach_mm, offsets = settings.reach_mm, settings.offsets
    if reach_mm is None or not offsets or not (settings.homing or settings.soft_limits):
        return ()
    problems = []
    for frame, bounds in program.bounds_by_frame.items():
        zero_mm = (0.0, 0.0, 0.0) if frame == "machine" else work_zero_mm(offsets, frame)
        if zero_mm is None:
            continue
        for axis, name in enumerate(_AXES):
            least, most = bounds.least_mm[axis], bounds.most_mm[axis]
            if least is None or most is None:
                continue
            shift = zero_mm[axis]
            low, high = reach_mm[axis]
            if least + shift < low - 1e-6 or most + shift > high + 1e-6:
                problems.append(
                    Phrase(
                        "{axis} would go from {least_mm:.3f} to {most_mm:.3f} mm in machine coordinates ({frame}); "
                        "the machine reaches {low_mm:g} to {high_mm:g}",
                        axis=name,
                        least_mm=least + shift,
                        most_mm=most + shift,
                        frame=frame,
                        low_mm=low,
                        high_mm=high,
                    )
                )
    return tuple(problems)
