"""The light of a job: what shines on the lens. Each kind of source has its own figures; others' are errors."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from service.job.spec.form import shown
from service.job.spec.section import Section

SUN_DEG = 0.53
MOST_PROFILE = 128  # values along a side
_KIND_OF = {"size_deg": "sun", "distance_mm": "point", "size_mm": "point"}
_KINDS = {
    "collimated": ("Parallel", "a spotlight far away, or a collimated lamp"),
    "sun": ("Sun", "half a degree wide: about 1 mm of blur for every 110 mm to the wall"),
    "point": ("Lamp", "a small bright lamp close by"),
}
_LEFT_OUT = {"size_deg": SUN_DEG, "size_mm": 0.0}
_RANGE = {
    "size_deg": "a number more than 0 and at most 10 degrees",
    "distance_mm": "a number from 10 to 100000 mm",
    "size_mm": "a number from 0 to 1000 mm",
}


class LightSpec(Section):
    """The light that enters the flat face of a lens, or falls on a mirror from above.

    kind        : "collimated"; "sun", a disc of directions; "point", a lamp at a distance
    size_deg    : angular diameter of the sun
    distance_mm : of the lamp from the flat face (of a mirror: from the stock top), on the axis through the aperture
    size_mm     : diameter of the lamp
    profile     : rows of relative strength on the aperture from rim to rim, top row first, as the picture is seen
    gaussian_mm : diameter at which a beam has fallen to 1/e^2 of its middle
    """

    kind: Annotated[
        Literal["collimated", "sun", "point"],
        shown("What shines on the lens", choices=_KINDS, card="light", look="cards"),
    ] = "collimated"
    size_deg: Annotated[
        Annotated[float, Field(gt=0, le=10)] | None,
        shown("Size of the sun in the sky", card="light", usual=f"{SUN_DEG:g}", when={"optics.light.kind": "sun"}),
    ] = Field(default=None, validate_default=True)
    distance_mm: Annotated[
        Annotated[float, Field(ge=10, le=100_000)] | None,
        shown("Lamp to the lens", card="light", usual="needed", start="1000", when={"optics.light.kind": "point"}),
    ] = Field(default=None, validate_default=True)
    size_mm: Annotated[
        Annotated[float, Field(ge=0, le=1000)] | None,
        shown(
            "Size of the lamp",
            "Its diameter; 0 is a point.",
            card="light",
            usual="0",
            when={"optics.light.kind": "point"},
        ),
    ] = Field(default=None, validate_default=True)
    profile: list[list[float]] | None = None
    gaussian_mm: Annotated[
        Annotated[float, Field(gt=0, le=20_000)] | None,
        shown("Beam diameter", "Where a laser's beam has fallen to 1/e² of its middle.", usual="even light"),
    ] = None

    @property
    def even(self) -> bool:
        """Whether nothing is said of where on the aperture it is stronger."""
        return self.profile is None and self.gaussian_mm is None

    @field_validator("size_deg", "distance_mm", "size_mm")
    @classmethod
    def _of_its_kind(cls, value: float | None, info: ValidationInfo) -> float | None:
        key, kind = str(info.field_name), info.data.get("kind")
        if kind is None:  # it is wrong itself, and said so
            return value
        if kind != _KIND_OF[key]:
            if value is not None:
                raise ValueError(f"{value:g} is not allowed with kind = '{kind}'; it belongs to '{_KIND_OF[key]}'")
            return None
        value = _LEFT_OUT.get(key) if value is None else value
        if value is None:
            raise ValueError(f"is missing, a light of kind '{kind}' needs it; allowed: {_RANGE[key]}")
        return value

    @field_validator("profile", mode="before")
    @classmethod
    def _rows_of_numbers(cls, rows: Any) -> Any:
        if rows is not None and (fault := _profile_fault(rows)):
            raise ValueError(
                f"{fault}; allowed: 2 to {MOST_PROFILE} rows of equally many numbers, 2 to {MOST_PROFILE}, none "
                f"negative, not all 0"
            )
        return rows

    @field_validator("gaussian_mm")
    @classmethod
    def _one_of_two(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is not None and info.data.get("profile") is not None:
            raise ValueError(f"{value:g} is not allowed beside profile; allowed: one of the two")
        return value


def _profile_fault(rows: Any) -> str | None:
    if not isinstance(rows, list | tuple) or not 2 <= len(rows) <= MOST_PROFILE:
        return f"{len(rows)} rows" if isinstance(rows, list | tuple) else "it is no list of rows"
    for number, row in enumerate(rows):
        if not isinstance(row, list | tuple):
            return f"row {number} is no list of numbers"
        if len(row) != len(rows[0]) or not 2 <= len(row) <= MOST_PROFILE:
            return f"row {number} has {len(row)} values, row 0 has {len(rows[0])}"
        for value in row:
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1e12:
                return f"row {number} holds {' '.join(repr(value)[:40].split())}"
    return None if any(value > 0 for row in rows for value in row) else "it is dark everywhere"
