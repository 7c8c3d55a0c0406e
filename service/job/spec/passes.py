"""A row of `passes` in the job spec. `cam.passes.PassSpec` has the same keys, and is made from it."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from cam.cutters import BALL, cutter_shape
from phrases.phrase import Phrase
from service.job.spec.section import Radius, Rate, RuleError, Section, Speed, StepDown, none_or_from, shown


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
    flute_length_mm: Annotated[
        Annotated[float, Field(ge=0.01, le=200)] | None, shown("Flute length", usual="not checked")
    ] = None
    shank_radius_mm: Annotated[
        Annotated[float, Field(ge=0.01, le=50)] | None, shown("Shank radius", usual="not checked")
    ] = None

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
                    "pitch_mm = {pitch_mm:g} is wider than the ball's radius; allowed: 0.002 to "
                    "radius_mm = {radius_mm:g}",
                    pitch_mm=self.pitch_mm,
                    radius_mm=self.radius_mm,
                )
            )
        return self

    @model_validator(mode="after")
    def _roughs_where_flat(self) -> Self:
        corner_mm = self.corner_radius_mm
        if corner_mm is not None and corner_mm > self.radius_mm:
            raise RuleError(
                Phrase(
                    "corner_radius_mm = {corner_mm:g} is more than the cutter's; allowed: 0 (flat) to "
                    "radius_mm = {radius_mm:g} (a ball)",
                    corner_mm=corner_mm,
                    radius_mm=self.radius_mm,
                )
            )
        roughs = self.stock_to_leave_mm > 0 and self.strategy == "raster" and self.where == "everywhere"
        if not self.is_ball and not roughs:
            raise RuleError(
                Phrase(
                    "corner_radius_mm = {corner_mm:g} is not a ball, and only a ball can finish a lens; allowed: "
                    'with stock_to_leave_mm above 0, strategy = "raster" and where = "everywhere"',
                    corner_mm=corner_mm,
                )
            )
        return self

    @model_validator(mode="after")
    def _goes_together(self) -> Self:
        if self.where == "rest" and self.strategy == "contour":
            raise RuleError(Phrase('where = "rest" goes with rows only; allowed: strategy = "raster"'))
        if self.shank_radius_mm is not None and self.flute_length_mm is None:
            raise RuleError(
                Phrase(
                    "shank_radius_mm = {radius_mm:g} has no effect without the height at which the shank begins; "
                    "allowed: with flute_length_mm",
                    radius_mm=self.shank_radius_mm,
                )
            )
        return self
