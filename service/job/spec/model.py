"""The job spec: everything a person can set about a lens, its stock, its passes and the mill. Lengths in mm.

One pydantic model; unknown keys are errors and the defaults make a complete job. `loading.py` reads it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from cam.materials import MATERIALS, PMMA
from service.job.spec.around import CutOutSpec, FaceSpec, cut_out_fault
from service.job.spec.finish import FinishSpec
from service.job.spec.light import LightSpec
from service.job.spec.optics import OpticsSpec
from service.job.spec.section import OneOf, Section

__all__ = [
    "FinishSpec",
    "ImageSpec",
    "JobSpec",
    "LightSpec",
    "MachineSpec",
    "OpticsSpec",
    "PassRow",
    "PlanSpec",
    "Section",
    "StockSpec",
]

PRESETS = ("paper", "draft", "recommended")
MAX_PIXELS = 4096
MOST_PASSES = 20
MAX_VERTICES = 8192  # of the lens along a side: 0.5 GB an array
MIN_FLOOR_MM = 2.0  # stock that must be left under the deepest point: less bends and rings under the cutter

Tool = Annotated[float, Field(gt=0, le=25)]
Rate = Annotated[float, Field(gt=0, le=50_000)]
Speed = Annotated[float, Field(gt=0, le=200_000)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]


class ImageSpec(Section):
    """How the picture is read. pixels counts along the screen's width.

    prepare           : "detail": contrast and tones are put where they will show on the wall; "none": it stays as it is
    prepare_detail_mm : the smallest detail that will show, on the screen; left out: by the throw and the light
    """

    pixels: Annotated[int, Field(ge=16, le=MAX_PIXELS)] = 512
    tone: Literal["srgb", "linear"] = "srgb"
    fit: Literal["crop", "pad", "stretch"] = "crop"
    invert: bool = False
    prepare: Literal["none", "detail"] = "none"
    prepare_detail_mm: Annotated[float, Field(gt=0, le=1000)] | None = None

    @field_validator("prepare_detail_mm")
    @classmethod
    def _of_a_preparation(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is not None and info.data.get("prepare") == "none":
            raise ValueError(f"{value:g} is not allowed with prepare = 'none'; it belongs to 'detail'")
        return value


class StockSpec(Section):
    """The block: thickness, a margin around the aperture, and the depth at which the highest point of the lens lies.

    face, cut_out : what is milled beside the lens; left out: nothing
    """

    thickness_mm: Annotated[float, Field(gt=0, le=500)] = 40.0
    margin_mm: Annotated[float, Field(ge=0, le=200)] = 8.0  # keeps a ring at Z0 beside the 6 mm that a 3 mm ball clears
    skim_mm: Annotated[float, Field(gt=0, le=10)] = 0.1
    material: Annotated[str, OneOf({name: {"title": one.label} for name, one in MATERIALS.items()})] = PMMA.name
    face: FaceSpec | None = None
    cut_out: CutOutSpec | None = None


class PassRow(Section):
    """One milling pass with a ball end mill; radius_mm is the RADIUS of the ball."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$", max_length=24)] = "finish"
    strategy: Literal["raster", "contour"] = "raster"
    direction: Literal["x", "y"] = "x"
    link: Literal["u-turn", "retract"] = "u-turn"
    where: Literal["everywhere", "rest"] = "everywhere"
    radius_mm: Tool
    pitch_mm: Annotated[float, Field(ge=0.002, le=25)]
    stock_to_leave_mm: Annotated[float, Field(ge=0, le=10)] = 0.0
    step_down_mm: Annotated[float, Field(ge=0.01, le=50)] | None = None
    feed_mm_per_min: Rate | None = None
    plunge_mm_per_min: Rate | None = None
    spindle_rpm: Speed | None = None
    flute_length_mm: Annotated[float, Field(gt=0, le=200)] | None = None
    shank_radius_mm: Annotated[float, Field(gt=0, le=50)] | None = None

    @model_validator(mode="after")
    def _pitch_fits_the_ball(self) -> Self:
        if self.pitch_mm > self.radius_mm:
            raise ValueError(
                f"pitch_mm = {self.pitch_mm:g} is wider than the ball's radius; allowed: 0.002 to "
                f"radius_mm = {self.radius_mm:g}"
            )
        return self

    @model_validator(mode="after")
    def _goes_together(self) -> Self:
        if self.where == "rest" and self.strategy == "contour":
            raise ValueError('where = "rest" goes with rows only; allowed: strategy = "raster"')
        if self.shank_radius_mm is not None and self.flute_length_mm is None:
            raise ValueError(
                f"shank_radius_mm = {self.shank_radius_mm:g} says nothing without the height at which it begins; "
                "allowed: with flute_length_mm"
            )
        return self


class MachineSpec(Section):
    """The mill: a profile by name, and any of its figures set otherwise. Triples are X, Y, Z."""

    profile: str = "grbl"
    travel_mm: Triple | None = None
    max_rate_mm_per_min: Triple | None = None
    acceleration_mm_per_s2: Triple | None = None
    step_mm: Annotated[float, Field(gt=0, le=1)] | None = None
    z_noise_mm: Annotated[float, Field(ge=0, le=0.1)] | None = None
    whole_steps: bool | None = None
    most_program_mb: Annotated[float, Field(ge=0.1, le=1_000_000)] | None = None
    most_program_hours: Annotated[float, Field(ge=0.05, le=10_000)] | None = None
    junction_deviation_mm: Annotated[float, Field(gt=0, le=1)] | None = None
    planner_blocks: Annotated[int, Field(ge=1, le=100_000)] | None = None
    lines_per_s: Annotated[float, Field(gt=0, le=1_000_000)] | None = None
    safe_z_mm: Annotated[float, Field(ge=0.5, le=200)] | None = None
    spindle_rpm: Annotated[list[Speed], Field(min_length=2, max_length=2)] | None = None
    coolant: Literal["none", "air", "mist", "flood"] | None = None
    blend_tolerance_mm: Annotated[float, Field(ge=0, le=1)] | None = None
    high_precision: Literal["none", "g05.1", "g08"] | None = None
    warm_up_s: Annotated[float, Field(ge=0, le=3600)] | None = None
    trace_outline: bool | None = None

    @field_validator("spindle_rpm")
    @classmethod
    def _slow_then_fast(cls, speeds: list[float] | None) -> list[float] | None:
        if speeds is not None and speeds[0] > speeds[1]:
            raise ValueError(f"{speeds} must hold the slowest speed, then the fastest")
        return speeds

    @field_validator("travel_mm", "max_rate_mm_per_min", "acceleration_mm_per_s2")
    @classmethod
    def _each_positive(cls, values: list[float] | None) -> list[float] | None:
        if values is not None and not all(0 < value <= 1_000_000 for value in values):
            raise ValueError(f"{values} must hold three numbers X, Y, Z, each more than 0 and at most 1000000")
        return values


class PlanSpec(Section):
    """What preset "recommended" aims at, one thing at the most: hours of machine time to stay within, the blur to stay
    under, or the PSNR to reach in the least time. Without any: nearly the best picture in the least time.
    """

    hours: Annotated[float, Field(gt=0, le=10_000)] | None = None
    blur_mm: Annotated[float, Field(gt=0, le=100)] | None = None
    psnr_db: Annotated[float, Field(gt=0, le=100)] | None = None

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        given = [name for name, value in self.model_dump().items() if value is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} cannot all be aimed at; allowed: one of them")
        return self


class JobSpec(Section):
    """A whole job. `passes` left out means those of the preset; those of "recommended" are planned for the picture."""

    preset: Literal["paper", "draft", "recommended"] = "paper"
    plan: PlanSpec = PlanSpec()
    image: ImageSpec = ImageSpec()
    optics: OpticsSpec = OpticsSpec()
    stock: StockSpec = StockSpec()
    passes: Annotated[
        tuple[PassRow, ...], Field(max_length=MOST_PASSES, strict=False, json_schema_extra={"minItems": 1})
    ]
    finish: FinishSpec = FinishSpec()
    machine: MachineSpec = MachineSpec()

    @field_validator("passes")
    @classmethod
    def _some(cls, passes: tuple[PassRow, ...], info: ValidationInfo) -> tuple[PassRow, ...]:
        if not passes and info.data.get("preset") != "recommended":
            raise ValueError(f"is empty; allowed: a list of 1 to {MOST_PASSES} tables")
        return passes

    @model_validator(mode="after")
    def _rest_of_something(self) -> Self:
        if self.passes and self.passes[0].where == "rest":
            raise ValueError('passes.0.where = "rest" has no pass before it; allowed: "everywhere" for the first')
        return self

    @model_validator(mode="after")
    def _can_be_cut_out(self) -> Self:
        if self.stock.cut_out is None:
            return self
        width_mm, height_mm = self.optics.width_mm, self.optics.height_mm
        fault = cut_out_fault(
            self.stock.cut_out,
            self.optics.outline_mm or [[0.0, 0.0], [width_mm, 0.0], [width_mm, height_mm], [0.0, height_mm]],
            size_mm=(width_mm, height_mm),
            margin_mm=self.stock.margin_mm,
            thickness_mm=self.stock.thickness_mm,
        )
        if fault is not None:
            raise ValueError(fault)
        return self

    @property
    def to_be_planned(self) -> bool:
        """Whether the passes are still to be found, from the picture."""
        return not self.passes

    @property
    def pixel_rows(self) -> int:
        """Picture rows: square pixels on the screen, as nearly as whole rows allow."""
        width_mm, height_mm = self.optics.screen_size_mm
        return max(1, round(self.image.pixels * height_mm / width_mm))

    @property
    def lens_radius_mm(self) -> float:
        """The ball that the lens is shaped for: as given, or the smallest that finishes; 0 for none."""
        if self.optics.min_radius_mm is not None:
            return self.optics.min_radius_mm
        finishing = [row.radius_mm for row in self.passes if row.stock_to_leave_mm == 0]
        if self.to_be_planned:
            return 0.0
        return 0.0 if self.optics.creases else min(finishing or [row.radius_mm for row in self.passes])

    @model_validator(mode="after")
    def _rows_in_range(self) -> Self:
        if not 16 <= self.pixel_rows <= MAX_PIXELS:
            width_mm, height_mm = self.optics.screen_size_mm
            raise ValueError(
                f"image.pixels = {self.image.pixels} on a screen of {width_mm:g} x {height_mm:g} mm makes "
                f"{self.pixel_rows} rows; allowed: 16 to {MAX_PIXELS}"
            )
        return self

    @model_validator(mode="after")
    def _vertices_in_range(self) -> Self:
        each, longer = self.optics.vertices_per_pixel, max(self.image.pixels, self.pixel_rows)
        each *= 2 if self.optics.creases else 1
        if each * longer > MAX_VERTICES:
            raise ValueError(
                f"optics.vertices_per_pixel = {self.optics.vertices_per_pixel} with {longer} pixels along a side "
                f"{'and creases ' * self.optics.creases}makes a lens of {each * longer} vertices; "
                f"allowed: at most {MAX_VERTICES}"
            )
        return self

    def plain(self) -> dict[str, Any]:
        """The spec as JSON-able data, without the keys that are not set."""
        return self.model_dump(mode="json", exclude_none=True)


USUAL_ROWS = (
    PassRow(name="rough", radius_mm=6.0, pitch_mm=2.0, stock_to_leave_mm=0.2),
    PassRow(name="finish", radius_mm=6.0, pitch_mm=0.07),
)
"""What passes that are still to be planned mostly come to: for sizes and shares of time until then."""
