"""Starting values for speeds and feeds, as data with its sources. They are offered to the user and never used as
limits.

A job's own index of refraction is `optics.refractive_index` in `service/job/spec/optics`; it starts from that here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import exp, floor, log

from cam.errors import PassValueError
from phrases.phrase import Phrase

SLOT_FEED = 0.5
"""Share of the feed where the ball cuts at its full width: along a layer's first row stock stands on both sides, and
between rows and along walls it may.
"""

SPINDLE_SHARE = 0.5
"""Share of a spindle's power that reaches the cutting edge; a guess."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CuttingData:
    """One ball end mill in one material. The plunge feed is also the feed of ramps."""

    radius_mm: float
    flutes: int
    spindle_rpm: int
    feed_mm_per_tooth: float
    step_down_mm: float
    plunge_share: float

    @property
    def feed_mm_per_min(self) -> float:
        return self.spindle_rpm * self.flutes * self.feed_mm_per_tooth

    @property
    def plunge_mm_per_min(self) -> float:
        return self.feed_mm_per_min * self.plunge_share


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Optical data, and cutting data for a few radii, ascending; between them the numbers are interpolated.

    name  : as a job says it
    label : as a person reads it
    block : what to buy, as the set-up sheet says it
    refractive_index  : of white light, as an eye weighs it; a job may give one of its own
    index_spread      : how far the index of one sheet may differ from it; None: not known
    dispersion        : n_F - n_C; None: not known, and all colours count as one
    haze              : share of the light that it scatters more than 2.5 degrees (ASTM D1003); None: not known
    density_g_per_cm3 : turns the weight that a finish takes off into a depth
    cutting_j_per_mm3 : the spindle's work per volume removed
    """

    name: str
    label: str
    block: Phrase
    refractive_index: float
    density_g_per_cm3: float
    advice: str
    sources: tuple[str, ...]
    cutting: tuple[CuttingData, ...]
    index_spread: float | None = None
    dispersion: float | None = None
    haze: float | None = None
    cutting_j_per_mm3: float = 0.5  # a guess: plastics take 0.1 in chips of 1 mm, several times that in thin ones

    def removal_mm3_per_min(self, spindle_w: float) -> float:
        """Return the largest removal rate of a spindle of that power."""
        return 60 * SPINDLE_SHARE * spindle_w / self.cutting_j_per_mm3

    def start_values(self, radius_mm: float) -> CuttingData:
        """Return cutting data for a ball of this radius: log-log between two entries, the nearest entry beyond them."""
        if not radius_mm > 0:
            raise PassValueError(name="radius_mm", value=radius_mm, allowed=Phrase("above {least:g} mm", least=0))
        if radius_mm <= self.cutting[0].radius_mm:
            return self.cutting[0]
        for low, high in pairwise(self.cutting):
            if radius_mm <= high.radius_mm:
                return _between(low, high, radius_mm)
        return self.cutting[-1]


def limit_step_down_mm(
    step_down_mm: float, pitch_mm: float, feed_mm_per_min: float, *, removal_mm3_per_min: float
) -> float:
    """Return the step-down, or a smaller one in whole hundredths at which rows keep within that removal rate.

    Shallower layers, not a slower feed: chips that become too thin rub and melt.
    """
    allowed_mm = removal_mm3_per_min / (pitch_mm * feed_mm_per_min)
    return step_down_mm if step_down_mm <= allowed_mm else max(0.01, floor(100 * allowed_mm) / 100)


def _between(low: CuttingData, high: CuttingData, radius_mm: float) -> CuttingData:
    share = log(radius_mm / low.radius_mm) / log(high.radius_mm / low.radius_mm)

    def mix(a: float, b: float) -> float:
        return exp(log(a) * (1 - share) + log(b) * share)

    return CuttingData(
        radius_mm=radius_mm,
        flutes=high.flutes,
        spindle_rpm=100 * round(mix(low.spindle_rpm, high.spindle_rpm) / 100),
        feed_mm_per_tooth=round(mix(low.feed_mm_per_tooth, high.feed_mm_per_tooth), 4),
        step_down_mm=round(mix(low.step_down_mm, high.step_down_mm), 3),
        plunge_share=mix(low.plunge_share, high.plunge_share),
    )


PMMA = Material(
    name="pmma",
    label="acrylic (PMMA)",
    block=Phrase("clear cast acrylic (PMMA), annealed"),
    refractive_index=1.49,
    index_spread=0.0035,
    dispersion=0.0085,
    haze=0.01,
    density_g_per_cm3=1.19,
    advice="Cast sheet, annealed; sharp polished carbide with one or two flutes; air blast, no alcohol.",
    sources=(
        "Acrylite, tech brief 'Routing': routers turn at 20 000 rpm or more",
        "Shapeoko CNC A to Z, 'Cutting plastics': 0.05 mm per tooth (0.002 in) at high speed, never below 0.025 mm "
        "for tools of 3 mm and more; 0.13-0.25 mm for 6 mm tools at low speed",
        "Wattsan, 'How to mill plexiglass': at most 4 mm deep when roughing",
        "Curbell Plastics, thermoplastic milling tables: 300-500 m/min",
        "catalogues of optical polymers, PMMA: n_d 1.4917, Abbe number 57.4 to 57.8, so n_F - n_C 0.0085 and 1.4933 in "
        "white; makers of sheet state 1.49",
        "makers of cast sheet state 1 % of haze (Yearlong, S-000, 3 mm, ASTM D1003), of resin less than 0.5 %",
        "for radii of 1 mm and less: 1-1.5 % of the diameter per tooth, a rule of thumb of cutter makers",
    ),
    cutting=(
        CuttingData(
            radius_mm=0.25,
            flutes=2,
            spindle_rpm=28000,
            feed_mm_per_tooth=0.006,
            step_down_mm=0.15,
            plunge_share=0.5,
        ),
        CuttingData(
            radius_mm=0.5, flutes=2, spindle_rpm=24000, feed_mm_per_tooth=0.0125, step_down_mm=0.4, plunge_share=0.5
        ),
        CuttingData(
            radius_mm=1.5, flutes=2, spindle_rpm=20000, feed_mm_per_tooth=0.03, step_down_mm=1.0, plunge_share=0.4
        ),
        CuttingData(
            radius_mm=3.0, flutes=2, spindle_rpm=15000, feed_mm_per_tooth=0.05, step_down_mm=1.5, plunge_share=0.4
        ),
    ),
)

MATERIALS: dict[str, Material] = {material.name: material for material in (PMMA,)}
"""Every material that a job can be milled in; the form, the spec and the set-up sheet take theirs from here."""
