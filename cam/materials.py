"""Starting values for speeds and feeds, as data with its sources. They are offered to the user and never used as
limits.

A job's own index of refraction is `optics.refractive_index` in `service/job/spec/optics`; it starts from that here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from math import exp, floor, log

from cam.errors import PassValueError
from phrases.phrase import Phrase

USUAL_INDEX = 1.49
"""Of the usual material."""

SLOT_FEED = 0.5
"""Share of the feed where the ball cuts at its full width: along a layer's first row stock stands on both sides;
between rows and along walls it sometimes does.
"""

LEAST_FEED = 0.2
"""The least share of the feed to which a feed that follows the load may fall."""

_EVEN_FASTER = 1.5
"""The share of the feed to which a feed that follows the load may rise, even if the band of the chip is narrow."""

SPINDLE_SHARE = 0.5
"""Share of a spindle's power that reaches the cutting edge; a guess."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CuttingData:
    """One ball end mill in one material. The plunge feed is also the feed of ramps.

    chip_mm : least and most feed per tooth: below, edges rub and heat; above, they chip or break
    """

    radius_mm: float
    flutes: int
    spindle_rpm: int
    feed_mm_per_tooth: float
    chip_mm: tuple[float, float]
    step_down_mm: float
    plunge_share: float

    @property
    def feed_mm_per_min(self) -> float:
        return self.spindle_rpm * self.flutes * self.feed_mm_per_tooth

    @property
    def plunge_mm_per_min(self) -> float:
        return self.feed_mm_per_min * self.plunge_share

    def choose_rpm(
        self, feed_mm_per_min: float, flutes: int, *, finishes: bool, spindle_rpm: tuple[float, float]
    ) -> float:
        """Return the speed at which this feed makes chips within the band, also where a pass slows down: at most the
        start value unless chips would be too thick, and within the spindle's range.

        finishes : the feed is the same everywhere except in slots; otherwise it follows the load

        One speed for a whole pass: GRBL stops the mill at every new S (grbl issue 633), other controls wait until the
        spindle has got there, and a ball that stands leaves a mark on the lens. A pass therefore gets the speed of its
        slow stretches, and its fast ones stay below the thickest chip (`cam.rows.loads`).
        """
        least_mm, most_mm = self.chip_mm
        share = SLOT_FEED if finishes else max(LEAST_FEED, _EVEN_FASTER * least_mm / most_mm)
        rpm = max(
            min(float(self.spindle_rpm), share * feed_mm_per_min / (flutes * least_mm)),
            feed_mm_per_min / (flutes * most_mm),
        )
        rpm = 10.0 * floor(rpm / 10 + 1e-9)
        return min(max(rpm, spindle_rpm[0]), spindle_rpm[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Optical data, and cutting data for a few radii, ascending; between them the numbers are interpolated.

    name  : as a job says it
    label : as a person reads it
    block : what to buy, as the set-up sheet says it
    refractive_index  : of white light, as an eye weighs it; a job may give one of its own
    index_spread      : how far the index of a single sheet may differ from it; None: not known
    dispersion        : n_F - n_C; None: not known, and all colours count as one
    haze              : share of the light that it scatters more than 2.5 degrees (ASTM D1003); None: not known
                        a metal has none: it makes mirrors
    reflectance       : of visible light, of a metal that is polished
    makers            : bands of feed per tooth that makers of cutters publish: source, diameter [mm], least, most [mm]
    density_g_per_cm3 : turns the weight that a finish takes off into a depth
    cutting_j_per_mm3 : the spindle's work per volume removed
    """

    name: str
    label: str
    block: Phrase
    refractive_index: float | None
    density_g_per_cm3: float
    advice: str
    sources: tuple[str, ...]
    cutting: tuple[CuttingData, ...]
    index_spread: float | None = None
    dispersion: float | None = None
    haze: float | None = None
    reflectance: float | None = None
    makers: tuple[tuple[str, float, float, float], ...] = ()
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
    """Return the step-down, or a smaller one in whole hundredths at which rows stay within that removal rate.

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
        chip_mm=(round(mix(low.chip_mm[0], high.chip_mm[0]), 4), round(mix(low.chip_mm[1], high.chip_mm[1]), 4)),
        step_down_mm=round(mix(low.step_down_mm, high.step_down_mm), 3),
        plunge_share=mix(low.plunge_share, high.plunge_share),
    )


def _row(
    radius_mm: float, spindle_rpm: int, feed_mm_per_tooth: float, chip_mm: tuple[float, float], step_down_mm: float,
    plunge_share: float,
) -> CuttingData:  # fmt: skip
    return CuttingData(
        radius_mm=radius_mm,
        flutes=2,
        spindle_rpm=spindle_rpm,
        feed_mm_per_tooth=feed_mm_per_tooth,
        chip_mm=chip_mm,
        step_down_mm=step_down_mm,
        plunge_share=plunge_share,
    )


_PLASTIC = (
    _row(0.25, 28000, 0.006, (0.003, 0.015), 0.15, 0.5),
    _row(0.5, 24000, 0.0125, (0.006, 0.03), 0.4, 0.5),
    _row(1.5, 20000, 0.03, (0.025, 0.13), 1.0, 0.4),
    _row(3.0, 15000, 0.05, (0.025, 0.25), 1.5, 0.4),
)
_METAL = (
    _row(0.25, 28000, 0.003, (0.0015, 0.006), 0.03, 0.3),
    _row(0.5, 24000, 0.006, (0.003, 0.012), 0.08, 0.3),
    _row(1.5, 20000, 0.02, (0.008, 0.04), 0.25, 0.3),
    _row(3.0, 15000, 0.04, (0.015, 0.08), 0.5, 0.3),
)
_HARVEY_PLASTICS_3 = ("Harvey Tool", 3.175, 0.025, 0.025)
_HARVEY_PLASTICS_6 = ("Harvey Tool", 6.35, 0.076, 0.076)
_AST_HARD_3, _AST_HARD_6 = ("AST Tooling", 3.175, 0.051, 0.102), ("AST Tooling", 6.35, 0.127, 0.203)
_AST_SOFT_3, _AST_SOFT_6 = ("AST Tooling", 3.175, 0.076, 0.127), ("AST Tooling", 6.35, 0.152, 0.229)
_SHAPEOKO_6 = ("Shapeoko CNC A to Z", 6.35, 0.025, 0.25)

PMMA = Material(
    name="pmma",
    label="acrylic (PMMA)",
    block=Phrase("clear cast acrylic (PMMA), annealed"),
    refractive_index=USUAL_INDEX,
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
        "for radii of 1 mm and less: 1-1.5 % of the diameter per tooth, a rule of thumb of cutter makers; the band "
        "from half to twice of it [guess]",
        "AST Tooling, chip load chart: hard plastic 0.05-0.10 mm at 1/8 in, 0.13-0.20 mm at 1/4 in; soft plastic "
        "0.08-0.13 and 0.15-0.23 mm",
        "Harvey Tool, general machining guidelines: acrylics 0.025 mm per tooth at 1/8 in, 0.076 mm at 1/4 in",
    ),
    makers=(_HARVEY_PLASTICS_3, _HARVEY_PLASTICS_6, _AST_HARD_3, _AST_HARD_6, _SHAPEOKO_6),
    cutting=_PLASTIC,
)
PMMA_EXTRUDED = replace(
    PMMA,
    name="pmma-extruded",
    label="extruded acrylic (PMMA)",
    block=Phrase("clear extruded acrylic (PMMA), annealed: it melts sooner than cast"),
    advice="Softer than cast and quick to melt: thick chips, air blast, single-flute cutter; anneal before finishing.",
    sources=(
        "makers of sheet state the same index for cast and extruded PMMA",
        "am.co.za, 'Chip load': extruded acrylic counts as a soft plastic, cast acrylic as a hard one",
        *PMMA.sources,
    ),
    makers=(_HARVEY_PLASTICS_3, _HARVEY_PLASTICS_6, _AST_SOFT_3, _AST_SOFT_6, _SHAPEOKO_6),
)
POLYCARBONATE = Material(
    name="polycarbonate",
    label="polycarbonate (PC)",
    block=Phrase("clear polycarbonate, dried and annealed"),
    refractive_index=1.589,
    dispersion=0.0201,
    haze=0.01,
    density_g_per_cm3=1.2,
    advice="Tough and gummy: sharp single-flute carbide, thick chips, air blast; no coolant that cracks it.",
    sources=(
        "Sultanova, Kasarova, Nikolov, Acta Phys. Pol. A 116 (2009) 585: n_d 1.585, Abbe number 29.1, so n_F - n_C "
        "0.0201 and 1.589 in white",
        "Curbell Plastics, milling guidelines: polycarbonate 980 ft/min, no coolants that crack it",
        "Harvey Tool, general machining guidelines: the same feed per tooth as acrylics",
        "density and haze: makers' data sheets of clear sheet state 1.2 g/cm3 and about 1 % [guess]",
        "speeds and step-downs as for PMMA [guess]",
    ),
    makers=(_HARVEY_PLASTICS_3, _HARVEY_PLASTICS_6, _AST_SOFT_3, _AST_SOFT_6),
    cutting=_PLASTIC,
)
_HARVEY_METALS = (("Harvey Tool", 3.175, 0.025, 0.025), ("Harvey Tool", 6.35, 0.051, 0.051))
_METAL_SOURCES = (
    "Harvey Tool, general machining guidelines, non-ferrous: 800-1500 ft/min, 0.025 mm per tooth at 1/8 in, 0.05 mm "
    "at 1/4 in",
    "G. W. Schultz, speeds and feeds for carbide end mills: 0.025 mm per tooth at 1/8 in, 0.05 mm at 1/4 in",
    "least feed per tooth: a third of theirs [guess]; step-downs, plunge feeds, and radii of 0.5 mm and less [guess]",
)
ALUMINIUM = Material(
    name="aluminium",
    label="aluminium (mirror)",
    block=Phrase("aluminium 6061 or a purer alloy, for a mirror"),
    refractive_index=None,
    reflectance=0.87,
    density_g_per_cm3=2.7,
    advice="Polished two-flute carbide for aluminium, mist or alcohol; polish by hand afterwards.",
    sources=(
        "bare aluminium film: 0.915 at 550 nm (RMI); a polished alloy reflects some percent less [guess]",
        *_METAL_SOURCES,
    ),
    cutting_j_per_mm3=0.9,  # a guess: handbooks have 0.4 to 1.1
    makers=_HARVEY_METALS,
    cutting=_METAL,
)
BRASS = Material(
    name="brass",
    label="brass (mirror)",
    block=Phrase("free-machining brass, for a mirror: it colours the light"),
    refractive_index=None,
    reflectance=0.7,
    density_g_per_cm3=8.5,
    advice="Sharp two-flute carbide, dry; lacquer the polished face, or it tarnishes.",
    sources=("reflectance at 550 nm, from optical constants of alpha brass near 0.5 + 2.2i [guess]", *_METAL_SOURCES),
    cutting_j_per_mm3=2.0,  # a guess: handbooks have 1.4 to 2.4
    makers=_HARVEY_METALS,
    cutting=_METAL,
)

MATERIALS: dict[str, Material] = {
    material.name: material for material in (PMMA, PMMA_EXTRUDED, POLYCARBONATE, ALUMINIUM, BRASS)
}
"""Every material that a job can be milled in; the form, the spec and the set-up sheet take theirs from here."""
