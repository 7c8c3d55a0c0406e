"""What a program does beside its cuts, and which control can: coolant, corners, the spindle brought up to speed.

Plain data without arrays, so that a job can be refused where nothing is computed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

Coolant = Literal["none", "air", "mist", "flood"]
HighPrecision = Literal["none", "g05.1", "g08"]

_GRBL_COOLANT = {"air": "M8", "mist": "M7", "flood": "M8"}
COOLANT_WORDS: Mapping[str, Mapping[str, str]] = {
    "grbl": _GRBL_COOLANT,
    "grblhal": _GRBL_COOLANT,
    "fluidnc": _GRBL_COOLANT,
    "linuxcnc": {"air": "M7", "mist": "M7", "flood": "M8"},
    "fanuc": {"flood": "M8"},
    "okuma": {"flood": "M8"},
}
"""By dialect. Stock GRBL has one output, M8, and M7 only where it was built in. On machining centres M8 is coolant
everywhere; which word opens the air or the mist is the builder's choice, so none is guessed."""

BLENDING = ("linuxcnc",)
HIGH_PRECISION_WORDS: Mapping[str, tuple[str, str]] = {"g05.1": ("G05.1Q1", "G05.1Q0"), "g08": ("G08P1", "G08P0")}
"""On and off, of Fanuc-like controls that have the option."""

WARM_UP_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the program's spindle speed, one step after the other for equal times."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramSetup:
    """What a program switches on before its first cut, and off after its last.

    blend_tolerance_mm : how far the path may leave its corners; 0: an exact stop at each; None: as the post has it
    warm_up_s          : the spindle comes up in WARM_UP_SHARES within this time; 0: at once
    slowest_rpm        : of the spindle; no step of the warm-up is slower
    """

    coolant: Coolant = "none"
    blend_tolerance_mm: float | None = None
    high_precision: HighPrecision = "none"
    warm_up_s: float = 0.0
    slowest_rpm: float = 0.0

    def without_warm_up(self) -> ProgramSetup:
        """The same for a program that another one has gone before."""
        return replace(self, warm_up_s=0.0)

    def spindle_steps(self, rpm: float, *, dwell_s: float) -> tuple[tuple[float, float], ...]:
        """(speed [rpm], dwell [s]) one after the other; the last speed is rpm.

        dwell_s : that a spindle needs to come up to speed at all
        """
        if not self.warm_up_s > 0:
            return ((rpm, dwell_s),)
        each_s = max(dwell_s, self.warm_up_s / len(WARM_UP_SHARES))
        steps: list[tuple[float, float]] = []
        for share in WARM_UP_SHARES:
            speed = min(rpm, max(float(round(share * rpm)), self.slowest_rpm)) if share < 1.0 else rpm
            if steps and steps[-1][0] == speed:
                steps[-1] = (speed, steps[-1][1] + each_s)
            else:
                steps.append((speed, each_s))
        return tuple(steps)


def find_unsupported(dialect: str, setup: ProgramSetup) -> Iterator[tuple[str, str, str]]:
    """(field, value in words, what is allowed) of all that a control of this dialect cannot do."""
    words = COOLANT_WORDS.get(dialect, {})
    if setup.coolant != "none" and setup.coolant not in words:
        allowed = " or ".join(f"'{name}'" for name in ("none", *words))
        yield "coolant", f"'{setup.coolant}'", f"{allowed} in dialect '{dialect}'"
    if setup.blend_tolerance_mm is not None and dialect not in BLENDING:
        yield (
            "blend_tolerance_mm",
            f"{setup.blend_tolerance_mm:g}",
            f"left out in dialect '{dialect}', which cannot be told a tolerance; {' and '.join(BLENDING)} can",
        )
    if setup.high_precision != "none" and dialect != "fanuc":
        yield "high_precision", f"'{setup.high_precision}'", f"'none' in dialect '{dialect}'; 'fanuc' has such modes"
