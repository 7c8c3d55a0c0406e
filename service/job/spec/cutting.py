"""The tables of the job spec for the cutting, the block and the mill: `passes`, `[stock]` and `[machine]`.

A row of `passes` has the keys of `cam.passes.PassSpec`, which is made from it. Rows make the lens: presets and plans
choose them, and they determine the light. Facing and cut-out make the block, independent of the passes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import dist
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from cam.cutters import BALL, CUTTERS, cutter_shape
from cam.materials import MATERIALS, PMMA
from machines.profile import MachineProfile
from machines.profile_values import Rules
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
Flutes = Annotated[float, Field(ge=0.01, le=200)]
StickOut = Annotated[float, Field(ge=0.5, le=300)]
MOST_CLAMPS = 20
MIN_FLOOR_MM = 2.0  # least stock under the deepest point: a thinner floor bends and vibrates under the cutter
FRAME_MM = 1.0
"""Width of the block that must remain around the slot: without it the tabs hold nothing."""

_PROFILE = Rules.of(MachineProfile)


def _as_in_profile(key: str) -> Any:
    """Return the limits that a profile sets to this figure."""
    low, high = _PROFILE.limits(key)
    return Field(ge=low, le=high)


Three = Field(min_length=3, max_length=3)
Travel = Annotated[list[Annotated[float, _as_in_profile("travel_mm")]], Three]
Rates = Annotated[list[Annotated[float, _as_in_profile("max_rate_mm_per_min")]], Three]
Accelerations = Annotated[list[Annotated[float, _as_in_profile("acceleration_mm_per_s2")]], Three]
Pair = Annotated[list[Speed], Field(min_length=2, max_length=2)]
_XYZ = ("X", "Y", "Z")
_USUAL_PROFILE = "grbl"
_shown = partial(shown, usual="machine's")  # missing values come from the profile


class PassRow(Section):
    """One milling pass; radius_mm is the RADIUS of its end mill.

    corner_radius_mm : 0 of a flat end mill, less than radius_mm of a bull-nose, for a first pass; left out: a ball
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$", max_length=24), shown("Name")] = "finish"
    radius_mm: Annotated[Radius, shown("Ball radius")]
    pitch_mm: Annotated[float, Field(ge=0.002, le=25), shown("Pitch")]
    stock_to_leave_mm: Annotated[float, Field(ge=0, le=10), none_or_from(0.0005), shown("Stock to leave")] = 0.0
    strategy: Annotated[
        Literal["raster", "contour"], shown("Strategy", choices={"raster": "rows", "contour": "contour lines"})
    ] = "raster"
    direction: Annotated[Literal["x", "y"], shown("Rows along", choices={"x": "X", "y": "Y"})] = "x"
    link: Annotated[
        Literal["u-turn", "retract"], shown("Between rows", choices={"u-turn": "turn", "retract": "lift"})
    ] = "u-turn"
    where: Annotated[
        Literal["everywhere", "rest"], shown("Where", choices={"everywhere": "everywhere", "rest": "only the rest"})
    ] = "everywhere"
    step_down_mm: Annotated[StepDown | None, shown("Step down", usual="usual")] = None
    feed_mm_per_min: Annotated[Rate | None, shown("Feed", usual="usual")] = None
    plunge_mm_per_min: Annotated[Rate | None, shown("Plunge", usual="usual")] = None
    spindle_rpm: Annotated[Speed | None, shown("Spindle", usual="usual")] = None
    flutes: Annotated[Annotated[int, Field(ge=1, le=8)] | None, shown("Flutes", usual="usual")] = None
    tool_name: Annotated[Annotated[str, Field(min_length=1, max_length=40)] | None, shown("Tool", usual="none")] = None
    tool_number: Annotated[
        Annotated[int, Field(ge=1, le=9999)] | None, shown("Tool number", "In the mill's tool table.", usual="none")
    ] = None
    flute_length_mm: Annotated[
        Annotated[float, Field(ge=0.01, le=200)] | None, shown("Flute length", usual="not checked")
    ] = None
    shank_radius_mm: Annotated[
        Annotated[float, Field(ge=0.01, le=50)] | None, shown("Shank radius", usual="not checked")
    ] = None
    stick_out_mm: Annotated[StickOut | None, shown("Sticks out", usual="the least")] = None

    corner_radius_mm: Annotated[
        Annotated[float, Field(ge=0, le=50), none_or_from(0.01)] | None,
        shown("Corner radius", "0: a flat end mill. Empty: a ball.", usual="ball"),
    ] = None

    @property
    def is_ball(self) -> bool:
        return cutter_shape(self.radius_mm, self.corner_radius_mm) is BALL

    @model_validator(mode="after")
    def _pitch_fits_the_ball(self) -> Self:
        if self.pitch_mm > self.radius_mm:
            raise RuleError(
                Phrase(
                    "{pitch_mm:g} is wider than the ball's radius; allowed: 0.002 to radius_mm = {radius_mm:g}",
                    pitch_mm=self.pitch_mm,
                    radius_mm=self.radius_mm,
                ),
                at="pitch_mm",
            )
        return self

    @model_validator(mode="after")
    def _roughs_where_flat(self) -> Self:
        corner_mm = self.corner_radius_mm
        if corner_mm is not None and corner_mm > self.radius_mm:
            raise RuleError(
                Phrase(
                    "{corner_mm:g} is more than the cutter's; allowed: 0 (flat) to radius_mm = {radius_mm:g} (a ball)",
                    corner_mm=corner_mm,
                    radius_mm=self.radius_mm,
                ),
                at="corner_radius_mm",
            )
        roughs = self.stock_to_leave_mm > 0 and self.strategy == "raster" and self.where == "everywhere"
        if not self.is_ball and not roughs:
            raise RuleError(
                Phrase(
                    "{corner_mm:g} is not a ball, and only a ball can finish a lens; allowed: with stock_to_leave_mm "
                    'above 0, strategy = "raster" and where = "everywhere"',
                    corner_mm=corner_mm,
                ),
                at="corner_radius_mm",
            )
        return self

    @model_validator(mode="after")
    def _goes_together(self) -> Self:
        if self.where == "rest" and self.strategy == "contour":
            raise RuleError(Phrase('"rest" goes with rows only; allowed: strategy = "raster"'), at="where")
        if self.shank_radius_mm is not None and self.flute_length_mm is None:
            raise RuleError(
                Phrase(
                    "{radius_mm:g} has no effect without the height at which the shank begins; allowed: with "
                    "flute_length_mm",
                    radius_mm=self.shank_radius_mm,
                ),
                at="shank_radius_mm",
            )
        return self


class FaceSpec(Section):
    """The raw top taken down to Z0 before the first pass. Pitch, speeds and feeds left out follow from `cam.cutters`.

    above_mm        : greatest height of the raw top above Z0
    shank_radius_mm : of what the collet holds; left out: as thick as the cutter
    """

    above_mm: Annotated[float, Field(ge=0.01, le=20)] = 1.0
    flutes: Annotated[int, Field(ge=1, le=8)] | None = None
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
                    "{pitch_mm:g} leaves stock between the rows; allowed: 0.01 to {most_mm:g}",
                    pitch_mm=self.pitch_mm,
                    most_mm=most_mm,
                ),
                at="pitch_mm",
            )
        return self


class CutOutSpec(Section):
    """The lens cut out along its outline after the last pass, by a flat end mill; tabs hold it in the block.

    tab_height_mm : from the block's bottom; tab_width_mm: along the outline, at their tops
    through_mm    : how far the cutter goes below the block
    flute_length_mm : of its edges; left out: the setup sheet states what it needs
    """

    radius_mm: Radius = 1.5
    shank_radius_mm: Radius | None = None
    flute_length_mm: Flutes | None = None
    tabs: Annotated[int, Field(ge=0, le=50)] = 4
    tab_width_mm: Annotated[float, Field(ge=0.1, le=100)] = 4.0
    tab_height_mm: Annotated[float, Field(ge=0.1, le=100)] = 1.5
    through_mm: Annotated[float, Field(ge=0, le=5), none_or_from(0.001)] = 0.0
    flutes: Annotated[int, Field(ge=1, le=8)] | None = None
    step_down_mm: StepDown | None = None
    feed_mm_per_min: Rate | None = None
    plunge_mm_per_min: Rate | None = None
    spindle_rpm: Speed | None = None


@dataclass(frozen=True, slots=True)
class ClampKind:
    """Clamps as they are sold. height_mm: of their highest part above what they hold"""

    title: str
    height_mm: float


CLAMPS = {
    # Strap of DIN 6314, washer of DIN 6340, nut of DIN 6330 (1.5 d), and half a diameter of the stud: for M6 10, 3, 9
    # and 3 mm. [k] from the standards' tables, not looked up again. A plate of 5 mm under a wing nut M6 (DIN 314, 16
    # mm), as small routers come with, is as high.
    "strap-m6": ClampKind("straps M6, 25 mm high", 25.0),
    "strap-m8": ClampKind("straps M8, 32 mm high", 32.0),
    "strap-m10": ClampKind("straps M10, 39 mm high", 39.0),
}


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
    base_mm       : of what the block lies on, over the table: spoil board, sub plate, vice; left out: what the mill
                    needs, as the setup sheet says
    clamping      : clamps of a usual kind, anywhere along the left and the right side: rapids cross over them, and
                    tools stick out as far as their height asks for; "none": the setup sheet says where which fit
    clamps        : places of others, for the check; the setup sheet shows where clamps may stand
    step_file     : write the lens for CAD, and state on the setup sheet what another shop must hold
    """

    thickness_mm: Annotated[float, Field(ge=0.5, le=500), shown("Thickness of the block", card="main")] = 40.0
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
    base_mm: Annotated[
        Annotated[float, Field(ge=0, le=1000), none_or_from(0.01)] | None,
        shown("Height under the block", "Spoil board, sub plate or vice, over the table.", usual="as needed"),
    ] = None
    clamping: Annotated[
        Literal["none", "strap-m6", "strap-m8", "strap-m10"],
        shown(
            "Clamps on top",
            "Along the left and the right side: rapids cross over them.",
            choices={"none": "none named", **{name: one.title for name, one in CLAMPS.items()}},
        ),
    ] = "none"
    face: FaceSpec | None = None
    cut_out: CutOutSpec | None = None
    clamps: Annotated[tuple[ClampSpec, ...], Field(max_length=MOST_CLAMPS, strict=False)] | None = None
    step_file: Annotated[
        bool,
        shown("Exact solid for CAD", "lens.step, for a shop with its own CAM; 75 MB for 512 pixels, packed to 15."),
    ] = False


def require_cut_out(
    cut_out: CutOutSpec,
    corners: Sequence[Sequence[float]],
    *,
    size_mm: tuple[float, float],
    margin_mm: float,
    thickness_mm: float,
) -> None:
    """Raise RuleError if the lens cannot be cut out so, at its key of the job.

    corners : of the lens in the work frame; size_mm: width and height of the aperture
    """
    room_mm = margin_mm + min(
        min(min(x, size_mm[0] - x) for x, _ in corners), min(min(y, size_mm[1] - y) for _, y in corners)
    )
    need_mm = 2 * cut_out.radius_mm + FRAME_MM
    if room_mm < need_mm:
        thinner = (room_mm - FRAME_MM) / 2
        words = Phrase(
            "{margin_mm:g} leaves {room_mm:.4g} mm beside the lens, but the cutter of radius {radius_mm:g} mm needs "
            "{need_mm:g} mm: its slot and {frame_mm:g} mm of frame; allowed: a margin of at least {least_mm:.4g}",
            margin_mm=margin_mm,
            room_mm=room_mm,
            radius_mm=cut_out.radius_mm,
            need_mm=need_mm,
            frame_mm=FRAME_MM,
            least_mm=margin_mm + need_mm - room_mm,
        )
        if thinner > 0:
            words = Phrase("{allowed}, or stock.cut_out.radius_mm up to {most_mm:.4g}", allowed=words, most_mm=thinner)
        raise RuleError(words, at="stock.margin_mm")
    if cut_out.tabs and cut_out.tab_height_mm > thickness_mm / 2:
        words = Phrase(
            "{height_mm:g} is more than half the block; allowed: at most {most_mm:g}",
            height_mm=cut_out.tab_height_mm,
            most_mm=thickness_mm / 2,
        )
        raise RuleError(words, at="stock.cut_out.tab_height_mm")
    around_mm = sum(dist(a, b) for a, b in pairwise([*corners, corners[0]]))
    if cut_out.tabs * (cut_out.tab_width_mm + 2 * cut_out.radius_mm) > around_mm:
        words = Phrase(
            "{count} of {width_mm:g} mm do not fit around {around_mm:.0f} mm of outline; allowed: at most {most}",
            count=cut_out.tabs,
            width_mm=cut_out.tab_width_mm,
            around_mm=around_mm,
            most=int(around_mm / (cut_out.tab_width_mm + 2 * cut_out.radius_mm)),
        )
        raise RuleError(words, at="stock.cut_out.tabs")


class MachineSpec(Section):
    """The mill: a profile by name, and any of its figures set otherwise. Triples are X, Y, Z."""

    profile: Annotated[
        str, shown("Machine", choices={_USUAL_PROFILE: _USUAL_PROFILE}, card="main", first=True, wide=True)
    ] = _USUAL_PROFILE
    travel_mm: Annotated[Travel | None, shown("Travel", names=_XYZ)] = None
    max_rate_mm_per_min: Annotated[Rates | None, shown("Fastest", names=_XYZ)] = None
    acceleration_mm_per_s2: Annotated[Accelerations | None, shown("Acceleration", names=_XYZ)] = None
    step_mm: Annotated[Annotated[float, _as_in_profile("step_mm")] | None, _shown("Smallest step")] = None
    z_noise_mm: Annotated[
        Annotated[float, _as_in_profile("z_noise_mm"), none_or_from(1e-7)] | None, _shown("Noise in Z")
    ] = None
    screw_error_mm: Annotated[
        Annotated[list[Annotated[float, _as_in_profile("screw_error_mm"), none_or_from(1e-7)]], Three] | None,
        shown("Screw errors", "An axis error that repeats with every turn of the screw.", names=_XYZ),
    ] = None
    screw_lead_mm: Annotated[
        Annotated[list[Annotated[float, _as_in_profile("screw_lead_mm")]], Three] | None,
        shown("Leads of the screws", names=_XYZ),
    ] = None
    whole_steps: Annotated[bool | None, _shown("On whole steps")] = None
    most_program_mb: Annotated[
        Annotated[float, _as_in_profile("most_program_mb")] | None, shown("Largest program", usual="no limit")
    ] = None
    most_program_hours: Annotated[
        Annotated[float, _as_in_profile("most_program_hours")] | None, shown("Longest program", usual="no limit")
    ] = None
    junction_deviation_mm: Annotated[Annotated[float, Field(ge=1e-5, le=1)] | None, _shown("Junction deviation")] = None
    planner_blocks: Annotated[Annotated[int, Field(ge=1, le=100_000)] | None, _shown("Blocks planned ahead")] = None
    lines_per_s: Annotated[Annotated[float, _as_in_profile("lines_per_s")] | None, _shown("Lines per second")] = None
    safe_z_mm: Annotated[Annotated[float, Field(ge=0.5, le=200)] | None, _shown("Safe height")] = None
    top_z_mm: Annotated[
        Annotated[float, _as_in_profile("top_z_mm"), none_or_from(0.001)] | None,
        _shown("Machine Z of the raised head", "Programs begin and end there."),
    ] = None
    bed_to_collet_mm: Annotated[
        Annotated[float, _as_in_profile("bed_to_collet_mm")] | None,
        _shown("Table to collet", "With the head at the top of its travel."),
    ] = None
    gantry_mm: Annotated[Annotated[float, _as_in_profile("gantry_mm")] | None, _shown("Table to gantry")] = None
    table_mm: Annotated[
        Annotated[list[Annotated[float, _as_in_profile("table_mm")]], Field(min_length=2, max_length=2)] | None,
        shown("Table", names=("X", "Y")),
    ] = None
    spindle_rpm: Annotated[Pair | None, shown("Spindle", names=("slowest", "fastest"))] = None
    collet_mm: Annotated[
        Annotated[float, _as_in_profile("collet_mm")] | None, _shown("Collet", "The thickest shank that it takes.")
    ] = None
    spindle_w: Annotated[Annotated[float, _as_in_profile("spindle_w")] | None, _shown("Spindle power")] = None
    removal_cm3_per_min: Annotated[
        Annotated[float, _as_in_profile("removal_cm3_per_min")] | None, _shown("Removal, cm³/min")
    ] = None
    coolant: Annotated[Literal["none", "air", "mist", "flood"] | None, _shown("Coolant or air")] = None
    work_offset: Annotated[
        Annotated[int, _as_in_profile("work_offset")] | None,
        _shown("Work offset", "1 to 6: G54 to G59, Okuma's G15 H1 to H6."),
    ] = None
    blend_tolerance_mm: Annotated[
        Annotated[float, _as_in_profile("blend_tolerance_mm"), none_or_from(1e-5)] | None,
        _shown("Corners rounded by", "LinuxCNC only; 0: exact stop."),
    ] = None
    high_precision: Annotated[
        Literal["none", "g05.1", "g08"] | None,
        _shown("High-precision mode", choices={"none": "none", "g05.1": "G05.1", "g08": "G08"}),
    ] = None
    tool_change: Annotated[bool | None, _shown("Tool changes", "T, M6 and G43 H (Okuma's G56 H) at the start.")] = None
    one_program: Annotated[
        bool | None,
        _shown("One program for all", "The programs of the job in one, with the tool changes between them."),
    ] = None
    optional_stop: Annotated[bool | None, _shown("Optional stop", "M1, before the spindle turns.")] = None
    units: Annotated[Literal["mm", "inch"] | None, _shown("Programs in")] = None
    number_every: Annotated[
        Annotated[int, _as_in_profile("number_every")] | None,
        shown("N words", "On every n-th line.", usual="usual"),
    ] = None
    warm_up_s: Annotated[
        Annotated[float, _as_in_profile("warm_up_s"), none_or_from(0.1)] | None,
        _shown("Spindle warm-up", "In the first program, in steps of speed."),
    ] = None
    trace_outline: Annotated[bool | None, _shown("Trace the block first")] = None

    @field_validator("spindle_rpm")
    @classmethod
    def _slow_then_fast(cls, speeds: list[float] | None) -> list[float] | None:
        if speeds is not None and speeds[0] > speeds[1]:
            raise RuleError(Phrase("{speeds} must hold the slowest speed, then the fastest", speeds=speeds))
        return speeds
