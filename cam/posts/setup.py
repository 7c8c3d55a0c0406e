"""What a program does beside its cuts: work offset, the head raised first and last, coolant, corners, the spindle.

Plain data without arrays, so that a job can be refused where nothing is computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

Coolant = Literal["none", "air", "mist", "flood"]
HighPrecision = Literal["none", "g05.1", "g08"]

HIGH_PRECISION_WORDS: Mapping[str, tuple[str, str]] = {"g05.1": ("G05.1Q1", "G05.1Q0"), "g08": ("G08P1", "G08P0")}
"""On and off, of Fanuc-like controls that have the option."""

WARM_UP_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the program's spindle speed, one step after the other for equal times."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramSetup:
    """What a program switches on before its first cut, and off after its last.

    work_offset        : 1 to 6: G54 to G59, or what the control calls them
    blend_tolerance_mm : how far the path may leave its corners; 0: an exact stop at each; None: as the post has it
    warm_up_s          : the spindle comes up in WARM_UP_SHARES within this time; 0: at once
    slowest_rpm        : of the spindle; no step of the warm-up is slower
    top_z_mm           : machine Z of the raised head, to which the program goes before it goes across, and at its end;
                         None: not known, it goes to the safe height over the work zero
    """

    coolant: Coolant = "none"
    work_offset: int = 1
    blend_tolerance_mm: float | None = None
    high_precision: HighPrecision = "none"
    warm_up_s: float = 0.0
    slowest_rpm: float = 0.0
    top_z_mm: float | None = None

    def without_warm_up(self) -> ProgramSetup:
        """Return the same for a program that another one has gone before."""
        return replace(self, warm_up_s=0.0)

    def spindle_steps(self, rpm: float, *, dwell_s: float) -> tuple[tuple[float, float], ...]:
        """Return (speed [rpm], dwell [s]) one after the other; the last speed is rpm.

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
