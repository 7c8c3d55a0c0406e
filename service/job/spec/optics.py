"""The lens and the screen of a job; the outline of a lens within its aperture, as corners in work-frame mm, seen from
above as it lies on the mill.

Plain Python, because the spec is checked in processes without numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise
from math import cos, dist, pi, sin
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from cam.materials import USUAL_INDEX
from phrases.phrase import Phrase
from service.job.spec.light import LIGHT_WORDS, LightSpec
from service.job.spec.section import Distance, Length, RuleError, Section, none_or_from, shown

_SHAPES = ("rectangle", "ellipse")
_LEAST_GAUSSIAN = (
    0.5  # share of the aperture's longer side: in the corners of a square 3e-7 of the strength in the middle is left
)

Shift = Annotated[float, Field(ge=-20_000, le=20_000), none_or_from(0.001)]
Blur = Annotated[float, Field(ge=0, le=100), none_or_from(1e-4)]
Screen = Annotated[float, Field(ge=0.5, le=20_000)]
Corner = Sequence[float]

MOST_CORNERS = 256
_ELLIPSE_CORNERS = 256  # on a lens of 100 mm the chords lie 4 um inside the ellipse
_NEAREST_MM = 1e-3  # distance of two corners: nearer ones count as one
_LEAST_FILLED = 0.05  # share of the aperture that a lens must fill


def ellipse_mm(width_mm: float, height_mm: float) -> list[list[float]]:
    """Return corners of the ellipse that touches all four rims, counter-clockwise."""
    angles = (2 * pi * k / _ELLIPSE_CORNERS for k in range(_ELLIPSE_CORNERS))
    return [[width_mm * (1 + cos(angle)) / 2, height_mm * (1 + sin(angle)) / 2] for angle in angles]


def counter_clockwise(corners: Sequence[Corner]) -> list[list[float]]:
    """Return the same corners in counter-clockwise order."""
    ordered = [[float(x), float(y)] for x, y in corners]
    return ordered if _signed_area(ordered) > 0 else ordered[::-1]


def outline_fault(corners: Sequence[Corner], *, width_mm: float, height_mm: float) -> Phrase | None:
    """Return a sentence about the fault of a closed outline; None if it can be the outline of a lens."""
    sides = list(pairwise([*corners, corners[0]]))
    for number, (x, y) in enumerate(corners):
        if not (0 <= x <= width_mm and 0 <= y <= height_mm):
            return Phrase(
                "corner {number} at X {x_mm:g} Y {y_mm:g} lies beyond the aperture of {width_mm:g} x {height_mm:g} mm",
                number=number,
                x_mm=x,
                y_mm=y,
                width_mm=width_mm,
                height_mm=height_mm,
            )
    for number, (here, there) in enumerate(sides):
        if dist(here, there) < _NEAREST_MM:
            following = (number + 1) % len(sides)
            return Phrase("corners {number} and {other} are the same point", number=number, other=following)
    for (j, one), (k, other) in combinations(enumerate(sides), 2):
        if k - j not in (1, len(sides) - 1) and _cross(*one, *other):
            return Phrase(
                "its sides {number} and {other} cross; allowed: corners in order, each side touching only its "
                "neighbours",
                number=j,
                other=k,
            )
    share = abs(_signed_area(corners)) / (width_mm * height_mm)
    if share < _LEAST_FILLED:
        return Phrase(
            "it fills {percent:.2g} % of the aperture; allowed: at least {least_percent:g} %",
            percent=100 * share,
            least_percent=100 * _LEAST_FILLED,
        )
    return None


def _signed_area(corners: Sequence[Corner]) -> float:
    """Return the area, positive if the corners run counter-clockwise."""
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise([*corners, corners[0]])) / 2


def _cross(a: Corner, b: Corner, c: Corner, d: Corner) -> bool:
    """Return whether the segments a-b and c-d have a point in common."""
    if max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0]):
        return False
    if max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1]):
        return False
    return _side(a, b, c) * _side(a, b, d) <= 0 and _side(c, d, a) * _side(c, d, b) <= 0


def _side(a: Corner, b: Corner, point: Corner) -> float:
    """Return a number that is positive if `point` lies to the left of a -> b."""
    return (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])


class OpticsSpec(Section):
    """The lens and the screen. The throw counts from the stock top; the screen is the aperture's size unless set.

    screen_shift_x_mm, .._y_mm : from the aperture's centre to the screen's, work frame
    min_radius_mm : valleys tighter than this ball are filled; 0: none are; left out: the ball of the finish pass
    branch        : "inverted": rays cross before the screen, so that black parts become ridges; "auto" chooses
    creases       : keep valleys as sharp as the picture requires, on a finer grid
    foreseen_blur_mm : predicted blur of the tool's marks, standard deviations in X and Y on the screen, by which the
                    lens is sharpened; [0, 0]: it is made for a perfect surface
    outline       : "rectangle", "ellipse", or corners [x_mm, y_mm] as seen from above on the mill
    """

    width_mm: Annotated[Length, shown("Width", card="main", filled=True)] = 100.0
    height_mm: Annotated[Length, shown("Height", card="main", filled=True)] = 100.0
    throw_mm: Annotated[Distance, shown("Distance to the wall", card="main", filled=True)] = 100.0
    refractive_index: Annotated[
        float,
        Field(ge=1.05, le=3.0),
        shown("Refractive index", "How strongly the material bends light: acrylic 1.49."),
    ] = USUAL_INDEX
    screen_width_mm: Annotated[Screen | None, shown("Picture width on the wall", usual="like the lens")] = None
    screen_height_mm: Annotated[Screen | None, shown("Picture height", usual="in proportion")] = None
    method: Annotated[
        Literal["transport", "paper"],
        shown("Method", choices={"transport": "optical path", "paper": "as published"}),
    ] = "transport"
    screen_shift_x_mm: Annotated[Shift, shown("Picture moved right")] = 0.0
    screen_shift_y_mm: Annotated[Shift, shown("Picture moved up")] = 0.0
    surface: Annotated[Literal["lens", "mirror"], shown("Surface")] = "lens"
    branch: Annotated[
        Literal["auto", "direct", "inverted"],
        shown(
            "Black areas",
            choices={"auto": "automatic", "direct": "shallow lens, greyer", "inverted": "deep lens, blacker"},
        ),
    ] = "auto"
    outline: Annotated[str | list[list[float]], shown("Outline", choices={shape: shape for shape in _SHAPES})] = (
        "rectangle"
    )
    min_radius_mm: Annotated[
        Annotated[float, Field(ge=0, le=25), none_or_from(0.01)] | None,
        shown("Smallest ball to fit", "Valleys tighter than this are filled; 0: none.", usual="of the finish"),
    ] = None
    creases: Annotated[bool, shown("Leave creases sharp")] = False
    vertices_per_pixel: Annotated[int, Field(ge=1, le=8), shown("Vertices per pixel")] = 2
    viewed_from: Annotated[
        Literal["lens", "behind"], shown("Looked at", choices={"lens": "on a wall", "behind": "from behind"})
    ] = "lens"
    corrections: Annotated[
        int, Field(ge=0, le=3), shown("Corrections", "Rounds against the lens's own light, 0 to 3.")
    ] = 2
    polish: Annotated[bool, shown("Polish the picture (slow)")] = False
    foreseen_blur_mm: Annotated[
        list[Blur],
        Field(min_length=2, max_length=2),
        shown(
            "Blur to work against",
            "The lens is made sharper by as much as the tool will blur.",
            names=("across", "up"),
        ),
    ] = [0.0, 0.0]  # noqa: RUF012
    light: LightSpec = LightSpec()

    @property
    def screen_size_mm(self) -> tuple[float, float]:
        """Width and height of the screen; a missing one follows from the aperture's proportion."""
        width, height = self.screen_width_mm, self.screen_height_mm
        if width is None:
            width = self.width_mm if height is None else height * self.width_mm / self.height_mm
        return width, width * self.height_mm / self.width_mm if height is None else height

    @property
    def outline_mm(self) -> list[list[float]] | None:
        """Corners of the lens, counter-clockwise; None: all of the aperture."""
        if isinstance(self.outline, str):
            return ellipse_mm(self.width_mm, self.height_mm) if self.outline == "ellipse" else None
        return counter_clockwise(self.outline)

    @property
    def outline_or_shape(self) -> str | list[list[float]]:
        """The name of a shape that has one, without corners in place of its curve; else the corners in order."""
        return self.outline if isinstance(self.outline, str) else counter_clockwise(self.outline)

    @property
    def light_crosses_block(self) -> bool:
        """Whether the thickness of the block affects the light."""
        return self.surface == "lens" and not LIGHT_WORDS[self.light.kind].is_square

    @field_validator("outline", mode="before")
    @classmethod
    def _shape_or_corners(cls, outline: Any) -> Any:
        if outline not in _SHAPES and not _is_list_of_pairs(outline):
            raise RuleError(
                Phrase(
                    "{value} is not allowed; allowed: 'rectangle', 'ellipse', or 3 to {most} corners "
                    "[[x_mm, y_mm], ...]",
                    value=repr(" ".join(str(outline).split())[:60]),
                    most=MOST_CORNERS,
                )
            )
        return outline

    @field_validator("outline")
    @classmethod
    def _lies_in_the_aperture(cls, outline: str | list[list[float]], info: ValidationInfo) -> str | list[list[float]]:
        size = info.data.get("width_mm"), info.data.get("height_mm")
        if isinstance(outline, str) or size[0] is None or size[1] is None:
            return outline
        if fault := outline_fault(outline, width_mm=size[0], height_mm=size[1]):
            raise RuleError(fault)
        return outline

    @field_validator("screen_shift_x_mm", "screen_shift_y_mm", "surface", "branch", "outline", "polish")
    @classmethod
    def _known_to_the_method(cls, value: Any, info: ValidationInfo) -> Any:
        usual = cls.model_fields[str(info.field_name)].default
        if info.data.get("method") == "paper" and value not in (usual, "direct"):
            raise RuleError(_none_but(repr(usual).lower() if isinstance(usual, bool) else repr(usual)))
        return value

    @field_validator("creases")
    @classmethod
    def _no_valley_is_filled(cls, value: bool, info: ValidationInfo) -> bool:
        if value and info.data.get("min_radius_mm"):
            radius = info.data["min_radius_mm"]
            raise RuleError(
                Phrase(
                    "true is not allowed with min_radius_mm = {radius_mm:g}, which fills creases; allowed: one",
                    radius_mm=radius,
                )
            )
        if value and info.data.get("method") == "paper":
            raise RuleError(_none_but("false"))
        return value

    @field_validator("light")
    @classmethod
    def _suits_the_lens(cls, light: LightSpec, info: ValidationInfo) -> LightSpec:
        if info.data.get("method") == "paper" and (light.distance_mm is not None or not light.even):
            raise RuleError(
                Phrase("only parallel, even light is possible with optics.method = 'paper'; 'transport' allows all"),
                at="kind" if light.distance_mm is not None else "profile" if light.profile else "gaussian_mm",
            )
        least = _LEAST_GAUSSIAN * max(info.data.get("width_mm", 0.0), info.data.get("height_mm", 0.0))
        if light.gaussian_mm is not None and light.gaussian_mm < least:
            raise RuleError(
                Phrase(
                    "{width_mm:g} leaves the rim of the lens dark; allowed: at least {least_mm:g} mm, half the longer "
                    "side",
                    width_mm=light.gaussian_mm,
                    least_mm=least,
                ),
                at="gaussian_mm",
            )
        return light


def _none_but(value: str) -> Phrase:
    return Phrase(
        "only {value} is possible with optics.method = 'paper'; 'transport' allows all",
        value=value,
    )


def _is_list_of_pairs(value: Any) -> bool:
    return (
        isinstance(value, list | tuple)
        and 3 <= len(value) <= MOST_CORNERS
        and all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in value)
        and all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e6 for pair in value for x in pair)
    )
