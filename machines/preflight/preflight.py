"""What is known of a program before it may run: extents, feeds, time, index, warnings. Plain data, kept as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from machines.gcode.program import ProgramIndex
from phrases.phrase import Phrase, phrases_in, restore


@dataclass(frozen=True, slots=True)
class Bounds:
    """Smallest box around all programmed points, mm; None for an axis that never was at a known place."""

    least_mm: tuple[float | None, float | None, float | None]
    most_mm: tuple[float | None, float | None, float | None]

    def span_mm(self, axis: int) -> float:
        least, most = self.least_mm[axis], self.most_mm[axis]
        return 0.0 if least is None or most is None else most - least


class Finding(NamedTuple):
    """What is worth a person's eye: the rule by its name in `machines.preflight.rules`, and the sentence.

    is_fault : a job with it fails, and `check`
    """

    code: str
    is_fault: bool
    words: Phrase


@dataclass(frozen=True, slots=True, kw_only=True)
class Preflight:
    """One program, read whole.

    blocks            : lines that are sent (neither blank nor only a comment)
    bounds_mm         : box in the first frame of `bounds_by_frame`, which has all: "G54" ... "machine" (G53), "shifted"
                        (after G92, G10 or G43.1 in the program: not comparable with the work zero)
    feeds_mm_per_min  : slowest and fastest feed of cutting moves; None without one
    spindle_rpm       : lowest and highest speed while the spindle turns; None if it never does
    time_s            : estimate for the mill's kinematics and link, without operator stops
    ends              : M2 or M30 was found
    mist_line         : the first line with M7, 0 if there is none: not every controller is built with it
    assumed           : modes relied on without being said, e.g. ("G21", "G90"): check against $G before a start
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
