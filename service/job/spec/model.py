"""The job spec: everything a person can set about a lens, its stock, its passes and the mill. Lengths in mm.

One pydantic model; unknown keys are errors and the defaults make a complete job. `loading.py` reads it.
"""

from __future__ import annotations

from functools import reduce
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from cam.materials import MATERIALS
from phrases.phrase import Phrase
from service.job.spec.cutting import MachineSpec, PassRow, StockSpec, require_cut_out
from service.job.spec.finish import FinishSpec
from service.job.spec.light import LightSpec
from service.job.spec.optics import OpticsSpec
from service.job.spec.section import RuleError, Section, shown

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
]

PRESETS = ("paper", "draft", "recommended")
MAX_PIXELS = 4096
MOST_PASSES = 20
MAX_VERTICES = 8192  # of the lens along a side: 0.5 GB an array

_PRESETS = {
    "draft": ("Draft", "fixed passes to try the mill; no work by hand"),
    "recommended": ("Recommended", "planned for this picture and mill"),
    "paper": ("As in the paper", "its three passes: very fine, slow"),
}
_LIKENESSES = {
    level: (f"{word} ({level} dB)", seen)
    for level, word, seen in (
        (21, "recognisable", "Recognisable, visibly soft or uneven."),
        (27, "plain", "Plainly the picture; fine detail or tones are off."),
        (33, "good", "Small differences, seen only side by side."),
        (40, "very close", "Very close to the target."),
    )
}
_WHEN_PLANNED = {"preset": "recommended"}


class ImageSpec(Section):
    """How the picture is read. pixels counts along the screen's width.

    prepare           : "detail": contrast and tones are moved to where the wall shows them; "none": unchanged
    prepare_detail_mm : the smallest detail that will show, on the screen; left out: from throw and light
    """

    pixels: Annotated[
        int,
        Field(ge=16, le=MAX_PIXELS),
        shown(
            "Pixels across",
            "More shows finer detail where the mill can cut it, and takes longer to compute.",
            card="picture",
        ),
    ] = 512
    tone: Annotated[
        Literal["srgb", "linear"],
        shown(
            "Brightness values",
            choices={"srgb": "as photos are (sRGB)", "linear": "linear light"},
            card="picture",
            wide=True,
        ),
    ] = "srgb"
    fit: Annotated[
        Literal["crop", "pad", "stretch"],
        shown(
            "If the shapes differ",
            choices={"crop": "choose a part", "pad": "whole picture, dark around", "stretch": "stretch"},
            card="picture",
            wide=True,
        ),
    ] = "crop"
    invert: Annotated[bool, shown("Negative", card="picture")] = False
    prepare: Annotated[
        Literal["none", "detail"],
        shown(
            "Prepared for the wall",
            "Contrast is raised in what is just large enough to show. The job shows both pictures beside each other.",
            choices={"none": "no, as it is", "detail": "yes: faces and detail brought out"},
            card="picture",
            wide=True,
        ),
    ] = "none"
    prepare_detail_mm: Annotated[
        Annotated[float, Field(ge=0.01, le=1000)] | None,
        shown(
            "Smallest detail that will show",
            "As the estimate gives it. Empty: about 1 mm for every 100 mm to the wall.",
            card="picture",
            usual="by the wall",
            when={"image.prepare": "detail"},
        ),
    ] = None

    @field_validator("prepare_detail_mm")
    @classmethod
    def _of_a_preparation(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is not None and info.data.get("prepare") == "none":
            raise RuleError(
                Phrase("{value:g} is not allowed with prepare = 'none'; it belongs to 'detail'", value=value)
            )
        return value


class PlanSpec(Section):
    """The goal of preset "recommended", at most one: machine time to stay within, blur to stay under, or PSNR to reach
    in the least time. Without a goal: nearly the best picture in the least time.
    """

    hours: Annotated[
        Annotated[float, Field(ge=0.01, le=10_000)] | None,
        shown("Time at most", "On the mill, all passes.", card="main", usual="no limit", when=_WHEN_PLANNED),
    ] = None
    blur_mm: Annotated[
        Annotated[float, Field(ge=0.001, le=100)] | None,
        shown("Blur at most", "On the wall. Instead of a time.", card="mill", usual="any", when=_WHEN_PLANNED),
    ] = None
    psnr_db: Annotated[
        Annotated[float, Field(ge=1, le=100)] | None,
        shown(
            "Likeness to reach",
            "Of the wall to the picture. Instead of a time.",
            choices=_LIKENESSES,
            card="mill",
            usual="any",
            when=_WHEN_PLANNED,
        ),
    ] = None

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        given = [name for name, value in self.model_dump().items() if value is not None]
        if len(given) > 1:
            aims = reduce(lambda names, name: Phrase("{names} and {name}", names=names, name=name), given)
            raise RuleError(Phrase("{aims} cannot all be aimed at; allowed: one of them", aims=aims), at=given[-1])
        return self


class JobSpec(Section):
    """A whole job. `passes` left out means those of the preset; those of "recommended" are planned for the picture."""

    preset: Annotated[
        Literal["paper", "draft", "recommended"],
        shown("How fine", choices=_PRESETS, card="main", look="cards"),
    ] = "paper"
    plan: Annotated[PlanSpec, Field(title="Plan")] = PlanSpec()
    image: Annotated[ImageSpec, Field(title="Picture")] = ImageSpec()
    optics: Annotated[OpticsSpec, Field(title="Optics")] = OpticsSpec()
    stock: Annotated[StockSpec, Field(title="Stock")] = StockSpec()
    passes: Annotated[
        tuple[PassRow, ...], Field(max_length=MOST_PASSES, strict=False, json_schema_extra={"minItems": 1})
    ]
    finish: Annotated[FinishSpec, Field(title="Finish by hand")] = FinishSpec()
    machine: Annotated[MachineSpec, Field(title="Machine")] = MachineSpec()

    @field_validator("passes")
    @classmethod
    def _some(cls, passes: tuple[PassRow, ...], info: ValidationInfo) -> tuple[PassRow, ...]:
        if not passes and info.data.get("preset") != "recommended":
            raise RuleError(Phrase("is empty; allowed: a list of 1 to {most} tables", most=MOST_PASSES))
        return passes

    @model_validator(mode="after")
    def _rest_of_something(self) -> Self:
        if self.passes and self.passes[0].where == "rest":
            raise RuleError(
                Phrase('"rest" has no pass before it; allowed: "everywhere" for the first'), at="passes.0.where"
            )
        return self

    @model_validator(mode="after")
    def _flat_first(self) -> Self:
        for number, row in enumerate(self.passes[1:], 1):
            if not row.is_ball:
                raise RuleError(
                    Phrase(
                        "{radius_mm:g} follows a pass that has cut the shape; allowed: in the first pass, a ball "
                        "after it",
                        radius_mm=row.corner_radius_mm,
                    ),
                    at=f"passes.{number}.corner_radius_mm",
                )
        return self

    @model_validator(mode="after")
    def _can_be_cut_out(self) -> Self:
        if self.stock.cut_out is None:
            return self
        width_mm, height_mm = self.optics.width_mm, self.optics.height_mm
        require_cut_out(
            self.stock.cut_out,
            self.optics.outline_mm or [[0.0, 0.0], [width_mm, 0.0], [width_mm, height_mm], [0.0, height_mm]],
            size_mm=(width_mm, height_mm),
            margin_mm=self.stock.margin_mm,
            thickness_mm=self.stock.thickness_mm,
        )
        return self

    @model_validator(mode="after")
    def _lets_light_through(self) -> Self:
        material = MATERIALS[self.stock.material]
        if material.refractive_index is None and self.optics.surface == "lens":
            raise RuleError(
                Phrase(
                    "{material} lets no light through; allowed: with optics.surface = 'mirror'", material=material.label
                ),
                at="stock.material",
            )
        return self

    @property
    def to_be_planned(self) -> bool:
        """Whether the passes are still to be planned from the picture."""
        return not self.passes

    @property
    def goes_on_after_passes(self) -> bool:
        """Whether a program after the passes mills the stock that they leave."""
        return self.finish.witnessed or self.stock.cut_out is not None

    @property
    def pixel_rows(self) -> int:
        """Picture rows: pixels on the screen as square as whole rows allow."""
        width_mm, height_mm = self.optics.screen_size_mm
        return max(1, round(self.image.pixels * height_mm / width_mm))

    @property
    def lens_radius_mm(self) -> float:
        """The ball for which the lens is shaped: as given, or the smallest that finishes; 0 for none."""
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
            raise RuleError(
                Phrase(
                    "{pixels} on a screen of {width_mm:g} x {height_mm:g} mm makes {rows} rows; allowed: {least} to "
                    "{most}",
                    pixels=self.image.pixels,
                    width_mm=width_mm,
                    height_mm=height_mm,
                    rows=self.pixel_rows,
                    least=16,
                    most=MAX_PIXELS,
                ),
                at="image.pixels",
            )
        return self

    @model_validator(mode="after")
    def _vertices_in_range(self) -> Self:
        each, longer = self.optics.vertices_per_pixel, max(self.image.pixels, self.pixel_rows)
        each *= 2 if self.optics.creases else 1
        if each * longer > MAX_VERTICES:
            values = {
                "each": self.optics.vertices_per_pixel,
                "pixels": longer,
                "vertices": each * longer,
                "most": MAX_VERTICES,
            }
            raise RuleError(
                Phrase(
                    "{each} with {pixels} pixels along a side and creases makes a lens of {vertices} vertices; "
                    "allowed: at most {most}",
                    **values,
                )
                if self.optics.creases
                else Phrase(
                    "{each} with {pixels} pixels along a side makes a lens of {vertices} vertices; allowed: at most "
                    "{most}",
                    **values,
                ),
                at="optics.vertices_per_pixel",
            )
        return self

    def plain(self) -> dict[str, Any]:
        """Return the spec as JSON-able data, without the keys that are not set."""
        return self.model_dump(mode="json", exclude_none=True)


USUAL_ROWS = (
    PassRow(name="rough", radius_mm=6.0, pitch_mm=2.0, stock_to_leave_mm=0.2),
    PassRow(name="finish", radius_mm=6.0, pitch_mm=0.07),
)
"""Typical passes, from which sizes and shares of time are estimated until the passes are planned."""
