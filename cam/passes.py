"""Passes as data: cutter, pitch, speeds and stock to leave; presets of them; and the block."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from cam.cutters import BALL, CutterShape, cutter_shape
from cam.errors import PassValueError
from cam.materials import PMMA
from phrases.phrase import Phrase

Strategy = Literal["raster", "contour"]
Direction = Literal["x", "y"]
Link = Literal["u-turn", "retract"]
Where = Literal["everywhere", "rest"]


def _require(name: str, value: float, *, above: float | None = None, at_least: float | None = None) -> None:
    if not math.isfinite(value):
        raise PassValueError(name=name, value=value, allowed=Phrase("a finite number"))
    if above is not None and not value > above:
        raise PassValueError(name=name, value=value, allowed=Phrase("above {least:g}", least=above))
    if at_least is not None and not value >= at_least:
        raise PassValueError(name=name, value=value, allowed=Phrase("at least {least:g}", least=at_least))


@dataclass(frozen=True, slots=True, kw_only=True)
class PassSpec:
    """One pass with one end mill: a ball, or a flat one for a first pass.

    corner_radius_mm  : 0 of a flat end mill, less than radius_mm of a bull-nose; None: a ball
    stock_to_leave_mm : measured along the surface normal
    step_down_mm      : the most stock one move may take off, measured along Z
    strategy          : rows, or one connected path along the contour lines of the lens
    direction         : rows along X or along Y
    link              : how rows are joined: an on-surface turn, or up, across and down again (paper, Fig. 13): slower,
                        but every row climb-mills
    where             : everywhere, or only at places that the pass before could not reach (cam.rows.rest)
    flute_length_mm   : length of the cutting edges, from the tip; None: not stated
    shank_radius_mm   : of the shank above the flutes; None: no thicker than the ball
    stick_out_mm      : from the tip to the collet, as clamped; None: as little as the program needs
    max_rate_mm_per_min : of the mill's axes X, Y, Z, which feeds that follow the load keep to
    flutes            : cutting edges
    chip_mm           : least and most feed per tooth; feeds that follow the load do not exceed the most
    tool_name, tool_number : of the shop, and in the mill's tool table; None: not stated
    """

    name: str
    strategy: Strategy = "raster"
    direction: Direction = "x"
    link: Link = "u-turn"
    where: Where = "everywhere"
    radius_mm: float
    pitch_mm: float
    stock_to_leave_mm: float
    step_down_mm: float
    feed_mm_per_min: float
    plunge_mm_per_min: float
    spindle_rpm: float
    flute_length_mm: float | None = None
    shank_radius_mm: float | None = None
    stick_out_mm: float | None = None
    corner_radius_mm: float | None = None
    max_rate_mm_per_min: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    flutes: int = 2
    chip_mm: tuple[float, float] = (0.0, math.inf)
    tool_name: str | None = None
    tool_number: int | None = None

    @property
    def layer_mm(self) -> float:
        """Distance between layers parallel to the lens: a fifth less than the step-down, because beside creases and
        beyond the rim there may be more stock than its cells show.
        """
        return 0.8 * self.step_down_mm

    def __post_init__(self) -> None:
        if self.strategy not in ("raster", "contour"):
            raise PassValueError(
                name="strategy",
                value=self.strategy,
                allowed=Phrase('"{one}" or "{other}"', one="raster", other="contour"),
            )
        if self.direction not in ("x", "y"):
            raise PassValueError(
                name="direction", value=self.direction, allowed=Phrase('"{one}" or "{other}"', one="x", other="y")
            )
        if self.link not in ("u-turn", "retract"):
            raise PassValueError(
                name="link", value=self.link, allowed=Phrase('"{one}" or "{other}"', one="u-turn", other="retract")
            )
        if self.where not in ("everywhere", "rest"):
            raise PassValueError(
                name="where", value=self.where, allowed=Phrase('"{one}" or "{other}"', one="everywhere", other="rest")
            )
        if self.where == "rest" and self.strategy != "raster":
            raise PassValueError(name="where", value=self.where, allowed=Phrase('only rows: strategy = "raster"'))
        for name in ("radius_mm", "step_down_mm", "feed_mm_per_min", "plunge_mm_per_min", "spindle_rpm"):
            _require(name, getattr(self, name), above=0)
        for name in ("flute_length_mm", "shank_radius_mm", "stick_out_mm"):
            if (value := getattr(self, name)) is not None:
                _require(name, value, above=0)
        _require("stock_to_leave_mm", self.stock_to_leave_mm, at_least=0)
        _require("pitch_mm", self.pitch_mm, at_least=0.001)
        if self.pitch_mm > self.radius_mm:
            allowed = Phrase("at most the ball's radius, {radius_mm:g} mm", radius_mm=self.radius_mm)
            raise PassValueError(name="pitch_mm", value=self.pitch_mm, allowed=allowed)

        if self.corner_radius_mm is not None:
            _require("corner_radius_mm", self.corner_radius_mm, at_least=0)
            if self.corner_radius_mm > self.radius_mm:
                allowed = Phrase("at most radius_mm = {radius_mm:g}", radius_mm=self.radius_mm)
                raise PassValueError(name="corner_radius_mm", value=self.corner_radius_mm, allowed=allowed)
            if not self.is_ball and (self.finishes or self.strategy != "raster" or self.where != "everywhere"):
                raise PassValueError(
                    name="corner_radius_mm",
                    value=self.corner_radius_mm,
                    allowed=Phrase("rows everywhere that leave stock"),
                )

    @property
    def is_ball(self) -> bool:
        return self.shape is BALL

    @property
    def shape(self) -> CutterShape:
        return cutter_shape(self.radius_mm, self.corner_radius_mm)

    @property
    def finishes(self) -> bool:
        """Whether no stock is left: this pass makes the optical surface."""
        return self.stock_to_leave_mm == 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Clamp:
    """A box on the block: x_mm, y_mm: its lower left corner in the work frame; height_mm: its height above Z0."""

    x_mm: float
    y_mm: float
    width_mm: float
    depth_mm: float
    height_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Stock:
    """The block: the aperture (width, height) with a margin on all four sides; its top is Z0."""

    width_mm: float
    height_mm: float
    thickness_mm: float
    margin_mm: float
    clamps: tuple[Clamp, ...] = ()

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm", "thickness_mm"):
            _require(name, getattr(self, name), above=0)
        _require("margin_mm", self.margin_mm, at_least=0)


def ball_pass(
    name: str,
    *,
    radius_mm: float,
    pitch_mm: float,
    stock_to_leave_mm: float,
    step_down_mm: float,
) -> PassSpec:
    """Return a pass with the start values of PMMA for its speeds."""
    start = PMMA.start_values(radius_mm)
    return PassSpec(
        name=name,
        radius_mm=radius_mm,
        pitch_mm=pitch_mm,
        stock_to_leave_mm=stock_to_leave_mm,
        step_down_mm=step_down_mm,
        feed_mm_per_min=start.feed_mm_per_min,
        plunge_mm_per_min=start.plunge_mm_per_min,
        spindle_rpm=start.spindle_rpm,
    )


PAPER_PASSES = (
    ball_pass("rough", radius_mm=3.0, pitch_mm=0.5, stock_to_leave_mm=0.2, step_down_mm=1.5),
    ball_pass("semi-finish", radius_mm=0.5, pitch_mm=0.05, stock_to_leave_mm=0.03, step_down_mm=0.4),
    ball_pass("finish", radius_mm=0.5, pitch_mm=0.02, stock_to_leave_mm=0.0, step_down_mm=0.1),
)
"""The paper's three passes (section 4): radii and pitches 3/0.5, 0.5/0.05, 0.5/0.02 mm.

Stock to leave and step-down are ours. The usual engagement is the stock that the pass before left, divided by the
cosine of the slope: 0.2 / 0.89 and 0.03 / 0.89 mm at slope 0.5. Deeper spots get extra layers.
"""
DRAFT_PASSES = (
    ball_pass("rough", radius_mm=3.0, pitch_mm=0.5, stock_to_leave_mm=0.2, step_down_mm=1.5),
    ball_pass("finish", radius_mm=3.0, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.4),
)
"""Two quick passes with one 3 mm ball: a coarser picture than the paper's, in half a day."""
PRESETS = {"paper": PAPER_PASSES, "draft": DRAFT_PASSES}
