"""[stock]: the block, what holds it, and what is milled beside the lens: its top, the cut-out. Lengths in mm.

Rows of `passes` make the lens: presets and plans choose them, and they determine the light. Facing and cut-out make the
block, independent of the passes.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import dist
from typing import Annotated, Self

from pydantic import Field, model_validator

from cam.cutters import CUTTERS
from cam.materials import MATERIALS, PMMA
from phrases.phrase import Phrase
from service.job.spec.section import (
    Length,
    OneOf,
    Radius,
    Rate,
    RuleError,
    Section,
    Speed,
    StepDown,
    none_or_from,
    shown,
)

Pitch = Annotated[float, Field(ge=0.01, le=50)]

MOST_CLAMPS = 20
MIN_FLOOR_MM = 2.0  # least stock under the deepest point: less bends and vibrates under the cutter
FRAME_MM = 1.0
"""Width of the block that must remain around the slot: without it the tabs hold nothing."""


class FaceSpec(Section):
    """The raw top taken down to Z0 before the first pass. Pitch, speeds and feeds left out follow from `cam.cutters`.

    above_mm        : greatest height of the raw top above Z0
    shank_radius_mm : of what the collet holds; left out: as thick as the cutter
    """

    above_mm: Annotated[float, Field(ge=0.01, le=20)] = 1.0
    tool: Annotated[str, OneOf({name: {} for name in CUTTERS})] = "flat"
    radius_mm: Radius = 3.0
    shank_radius_mm: Radius | None = None
    pitch_mm: Pitch | None = None
    step_down_mm: StepDown | None = None
    feed_mm_per_min: Rate | None = None
    plunge_mm_per_min: Rate | None = None
    spindle_rpm: Speed | None = None

    @model_validator(mode="after")
    def _rows_overlap(self) -> Self:
        most_mm = CUTTERS[self.tool].widest_pitch_mm(self.radius_mm)
        if self.pitch_mm is not None and self.pitch_mm > most_mm:
            raise RuleError(
                Phrase(
                    "pitch_mm = {pitch_mm:g} leaves stock between the rows; allowed: 0.01 to {most_mm:g}",
                    pitch_mm=self.pitch_mm,
                    most_mm=most_mm,
                )
            )
        return self


class CutOutSpec(Section):
    """The lens cut out along its outline after the last pass, by a flat end mill; tabs hold it in the block.

    tab_height_mm : from the block's bottom; tab_width_mm: along the outline, at their tops
    through_mm    : how far the cutter goes below the block
    """

    radius_mm: Radius = 1.5
    shank_radius_mm: Radius | None = None
    tabs: Annotated[int, Field(ge=0, le=50)] = 4
    tab_width_mm: Annotated[float, Field(ge=0.1, le=100)] = 4.0
    tab_height_mm: Annotated[float, Field(ge=0.1, le=100)] = 1.5
    through_mm: Annotated[float, Field(ge=0, le=5), none_or_from(0.001)] = 0.0
    step_down_mm: StepDown | None = None
    feed_mm_per_min: Rate | None = None
    plunge_mm_per_min: Rate | None = None
    spindle_rpm: Speed | None = None


class ClampSpec(Section):
    """What holds the block, as a box on its top that no program may come near; corner in the work frame."""

    x_mm: Annotated[float, Field(ge=-2000, le=2000), none_or_from(0.001)]
    y_mm: Annotated[float, Field(ge=-2000, le=2000), none_or_from(0.001)]
    width_mm: Length
    depth_mm: Length
    height_mm: Annotated[float, Field(ge=0.1, le=200)]


class StockSpec(Section):
    """The block: thickness, a margin around the aperture, and the depth at which the highest point of the lens lies.

    face, cut_out : programs beside the lens; left out: none
    haze_percent  : share of the light that the block scatters by more than 2.5 degrees; left out: that of its material
    back_flatness_mm, back_period_mm : distance of the two planes that hold the waves of the face that light enters by,
                    and the length of these waves; left out: taken as flat
    clamps        : their places, for the check; the setup sheet shows where clamps may stand
    """

    thickness_mm: Annotated[float, Field(ge=0.5, le=500), shown("Thickness")] = 40.0
    # The default keeps a ring that can be clamped beside the 6 mm that a 3 mm ball clears.
    margin_mm: Annotated[float, Field(ge=0, le=200), none_or_from(0.01), shown("Margin around")] = 14.0
    skim_mm: Annotated[float, Field(ge=0.001, le=10), shown("Skim off the top")] = 0.1
    material: Annotated[
        str, OneOf({name: {"title": one.label} for name, one in MATERIALS.items()}), shown("Material")
    ] = PMMA.name
    haze_percent: Annotated[
        Annotated[float, Field(ge=0, le=50), none_or_from(1e-3)] | None,
        shown("Haze", "Share of the light that the block scatters: 1 % of new acrylic.", usual="of the material"),
    ] = None
    back_flatness_mm: Annotated[
        Annotated[float, Field(ge=0, le=1), none_or_from(1e-5)] | None,
        shown("Waves of the back", "Height of the waves of the face that light enters by.", usual="taken as flat"),
    ] = None
    back_period_mm: Annotated[float, Field(ge=1, le=1000), shown("Their length")] = 40.0
    face: FaceSpec | None = None
    cut_out: CutOutSpec | None = None
    clamps: Annotated[tuple[ClampSpec, ...], Field(max_length=MOST_CLAMPS, strict=False)] | None = None


def cut_out_fault(
    cut_out: CutOutSpec,
    corners: Sequence[Sequence[float]],
    *,
    size_mm: tuple[float, float],
    margin_mm: float,
    thickness_mm: float,
) -> Phrase | None:
    """Return why the lens cannot be cut out so, with the numbers; None if it can.

    corners : of the lens in the work frame; size_mm: width and height of the aperture
    """
    room_mm = margin_mm + min(
        min(min(x, size_mm[0] - x) for x, _ in corners), min(min(y, size_mm[1] - y) for _, y in corners)
    )
    need_mm = 2 * cut_out.radius_mm + FRAME_MM
    if room_mm < need_mm:
        thinner = (room_mm - FRAME_MM) / 2
        words = Phrase(
            "stock.margin_mm = {margin_mm:g} leaves {room_mm:.4g} mm beside the lens, but the cutter of radius "
            "{radius_mm:g} mm needs {need_mm:g} mm: its slot and {frame_mm:g} mm of frame; allowed: a margin of at "
            "least {least_mm:.4g}",
            margin_mm=margin_mm,
            room_mm=room_mm,
            radius_mm=cut_out.radius_mm,
            need_mm=need_mm,
            frame_mm=FRAME_MM,
            least_mm=margin_mm + need_mm - room_mm,
        )
        if thinner <= 0:
            return words
        return Phrase("{allowed}, or stock.cut_out.radius_mm up to {most_mm:.4g}", allowed=words, most_mm=thinner)
    if cut_out.tabs and cut_out.tab_height_mm > thickness_mm / 2:
        return Phrase(
            "stock.cut_out.tab_height_mm = {height_mm:g} is more than half the block; allowed: at most {most_mm:g}",
            height_mm=cut_out.tab_height_mm,
            most_mm=thickness_mm / 2,
        )
    around_mm = sum(dist(a, b) for a, b in pairwise([*corners, corners[0]]))
    if cut_out.tabs * (cut_out.tab_width_mm + 2 * cut_out.radius_mm) > around_mm:
        return Phrase(
            "stock.cut_out.tabs = {count} of {width_mm:g} mm do not fit around {around_mm:.0f} mm of outline; allowed: "
            "at most {most}",
            count=cut_out.tabs,
            width_mm=cut_out.tab_width_mm,
            around_mm=around_mm,
            most=int(around_mm / (cut_out.tab_width_mm + 2 * cut_out.radius_mm)),
        )
    return None
