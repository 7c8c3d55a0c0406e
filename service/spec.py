"""The job spec: everything a person can set about a lens, its stock, its passes and the mill. Lengths in mm.

One pydantic model; unknown keys are errors and the defaults make a complete job. `service/spec_files.py` reads it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

PRESETS = ("paper", "draft")
MATERIALS = ("pmma",)
MAX_PIXELS = 4096
MIN_FLOOR_MM = 2.0  # stock that must be left under the deepest point: less bends and rings under the cutter

Length = Annotated[float, Field(gt=0, le=2000)]
Distance = Annotated[float, Field(gt=0, le=100_000)]
Tool = Annotated[float, Field(gt=0, le=25)]
Rate = Annotated[float, Field(gt=0, le=50_000)]
Speed = Annotated[float, Field(gt=0, le=200_000)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]


class Section(BaseModel):
    """A table of the spec: exact types, finite numbers, no unknown keys, frozen."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class ImageSpec(Section):
    """How the picture is read. pixels counts along the screen's width."""

    pixels: Annotated[int, Field(ge=16, le=MAX_PIXELS)] = 512
    tone: Literal["srgb", "linear"] = "srgb"
    fit: Literal["crop", "pad", "stretch"] = "crop"
    invert: bool = False


class LightSpec(Section):
    """The light that enters the flat face. Collimated only, so far."""

    kind: Literal["collimated"] = "collimated"

    @field_validator("kind", mode="before")
    @classmethod
    def _available(cls, kind: object) -> object:
        if kind in ("sun", "point"):
            raise ValueError(f"light '{kind}' is not available yet; allowed: 'collimated'")
        return kind


class OpticsSpec(Section):
    """The lens and the screen. The throw counts from the stock top; the screen is the aperture's size unless set."""

    width_mm: Length = 100.0
    height_mm: Length = 100.0
    throw_mm: Distance = 100.0
    refractive_index: Annotated[float, Field(ge=1.05, le=3.0)] = 1.49
    screen_width_mm: Annotated[float, Field(gt=0, le=20_000)] | None = None
    screen_height_mm: Annotated[float, Field(gt=0, le=20_000)] | None = None
    min_radius_mm: Annotated[float, Field(ge=0, le=25)] = 0.5  # valleys tighter than this ball are filled; 0: none are
    method: Literal["transport", "paper"] = "transport"
    viewed_from: Literal["lens", "behind"] = "lens"
    corrections: Annotated[int, Field(ge=0, le=3)] = 2
    light: LightSpec = LightSpec()

    @property
    def screen_size_mm(self) -> tuple[float, float]:
        """Width and height of the screen; one that is not given follows the other in the aperture's proportion."""
        width, height = self.screen_width_mm, self.screen_height_mm
        if width is None:
            width = self.width_mm if height is None else height * self.width_mm / self.height_mm
        return width, width * self.height_mm / self.width_mm if height is None else height


class StockSpec(Section):
    """The block: thickness, a margin around the aperture, and the depth at which the highest point of the lens lies."""

    thickness_mm: Annotated[float, Field(gt=0, le=500)] = 40.0
    margin_mm: Annotated[float, Field(ge=0, le=200)] = 8.0  # keeps a ring at Z0 beside the 6 mm that a 3 mm ball clears
    skim_mm: Annotated[float, Field(gt=0, le=10)] = 0.1
    material: Literal["pmma"] = "pmma"


class PassRow(Section):
    """One milling pass with a ball end mill; radius_mm is the RADIUS of the ball."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$", max_length=24)] = "finish"
    strategy: Literal["raster"] = "raster"
    link: Literal["u-turn", "retract"] = "u-turn"
    radius_mm: Tool
    pitch_mm: Annotated[float, Field(ge=0.002, le=25)]
    stock_to_leave_mm: Annotated[float, Field(ge=0, le=10)] = 0.0
    step_down_mm: Annotated[float, Field(ge=0.01, le=50)] | None = None
    feed_mm_per_min: Rate | None = None
    plunge_mm_per_min: Rate | None = None
    spindle_rpm: Speed | None = None

    @field_validator("strategy", mode="before")
    @classmethod
    def _available(cls, strategy: object) -> object:
        if strategy == "contour":
            raise ValueError("strategy 'contour' is not available yet; allowed: 'raster'")
        return strategy

    @model_validator(mode="after")
    def _pitch_fits_the_ball(self) -> Self:
        if self.pitch_mm > self.radius_mm:
            raise ValueError(
                f"pitch_mm = {self.pitch_mm:g} is wider than the ball's radius; allowed: 0.002 to "
                f"radius_mm = {self.radius_mm:g}"
            )
        return self


class MachineSpec(Section):
    """The mill: a profile by name, and any of its figures set otherwise. Triples are X, Y, Z."""

    profile: str = "grbl"
    travel_mm: Triple | None = None
    max_rate_mm_per_min: Triple | None = None
    acceleration_mm_per_s2: Triple | None = None
    step_mm: Annotated[float, Field(gt=0, le=1)] | None = None
    junction_deviation_mm: Annotated[float, Field(gt=0, le=1)] | None = None
    planner_blocks: Annotated[int, Field(ge=1, le=100_000)] | None = None
    lines_per_s: Annotated[float, Field(gt=0, le=1_000_000)] | None = None
    safe_z_mm: Annotated[float, Field(ge=0.5, le=200)] | None = None
    spindle_rpm: Annotated[list[Speed], Field(min_length=2, max_length=2)] | None = None

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


class JobSpec(Section):
    """A whole job. `passes` left out means those of the preset."""

    preset: Literal["paper", "draft"] = "paper"
    image: ImageSpec = ImageSpec()
    optics: OpticsSpec = OpticsSpec()
    stock: StockSpec = StockSpec()
    passes: Annotated[tuple[PassRow, ...], Field(min_length=1, max_length=20, strict=False)]
    machine: MachineSpec = MachineSpec()

    @property
    def pixel_rows(self) -> int:
        """Picture rows: square pixels on the screen, as nearly as whole rows allow."""
        width_mm, height_mm = self.optics.screen_size_mm
        return max(1, round(self.image.pixels * height_mm / width_mm))

    @model_validator(mode="after")
    def _rows_in_range(self) -> Self:
        if not 16 <= self.pixel_rows <= MAX_PIXELS:
            width_mm, height_mm = self.optics.screen_size_mm
            raise ValueError(
                f"image.pixels = {self.image.pixels} on a screen of {width_mm:g} x {height_mm:g} mm makes "
                f"{self.pixel_rows} rows; allowed: 16 to {MAX_PIXELS}"
            )
        return self

    def plain(self) -> dict[str, Any]:
        """The spec as JSON-able data, without the keys that are not set."""
        return self.model_dump(mode="json", exclude_none=True)
