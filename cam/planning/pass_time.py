"""Estimates the time of a pass before it is written: rows at the speed that feed, line rate and look-ahead allow.

`cam.duration` gives the time of a written program; this is within some percent of it, from the lens's form alone. The
speed of a chord is the least of: the feed; its length times the lines a second; the speed from which it can brake
within the look-ahead window, at chords of that length. Chords are as long as `cam.rows.vertices` allows on the path of
the tip, which is the lens's curvature offset by the ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, sqrt

import numpy as np

from cam.duration import Kinematics
from cam.passes import Direction, PassSpec, Strategy
from cam.planning.row_slopes import tooth_slopes_rad
from cam.rows.entries import RAMP_SLOPE
from cam.rows.vertices import SLOPE_ERROR_RAD, VertexRule, finish_rule, rough_rule
from cam.surface.stock_touch import concave_curvature, dilate
from optics.heightfield import Array, Heightfield

_SAMPLES = 160  # along a side of the lens
_PLACES_A_RADIUS = 16  # most places per radius; between them a ball bends by a two-thousandth of its radius
_USED = 0.85  # of the chord length that the rule allows
_LEAST_GAP = 0.25  # of 1 - kR: nearer to 0 the ball hardly fits, and its grooves are no longer those of rows
LAYER_STRIDE = 0.2  # of the radius: rows of the layers of a finishing pass


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensForm:
    """The data of a lens for plans, (n,) over evenly spread places.

    heights_mm       : sorted
    slopes           : of the surface, sorted
    bends_x, bends_y : curvature along X and along Y, positive in a hollow [1/mm]
    steep_x, steep_y : change of the slope along X and along Y on a ball that touches, by way over radius
    turns_rad        : direction of the gradient
    hollows_per_mm   : greatest principal curvature, sorted, positive in a hollow
    """

    width_mm: float
    height_mm: float
    heights_mm: Array
    slopes: Array
    slopes_x: Array
    slopes_y: Array
    bends_x: Array
    bends_y: Array
    steep_x: Array
    steep_y: Array
    turns_rad: Array
    hollows_per_mm: Array
    lens: Heightfield

    @classmethod
    def of(cls, lens: Heightfield) -> LensForm:
        along = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        x, y = np.meshgrid(lens.x_mm[0] + along * lens.width_mm, lens.y_mm[0] + along * lens.height_mm)
        return cls._at(lens, np.ravel(x), np.ravel(y), np.sort(concave_curvature(lens), axis=None))

    def among(self, x_mm: Array, y_mm: Array) -> LensForm:
        """Return the form of the same lens at only those places (n,); its sides and hollows are those of the whole."""
        return self._at(self.lens, x_mm, y_mm, self.hollows_per_mm)

    @classmethod
    def _at(cls, lens: Heightfield, x_mm: Array, y_mm: Array, hollows_per_mm: Array) -> LensForm:
        z, p, q, r, _, t = lens.spline().jets(x_mm, y_mm)
        square = 1.0 + p * p + q * q
        return cls(
            width_mm=lens.width_mm,
            height_mm=lens.height_mm,
            heights_mm=np.sort(z),
            slopes=np.sort(np.hypot(p, q)),
            slopes_x=p,
            slopes_y=q,
            bends_x=r / (1.0 + p * p) / np.sqrt(square),
            bends_y=t / (1.0 + q * q) / np.sqrt(square),
            steep_x=(1.0 + p * p) * np.sqrt(square),
            steep_y=(1.0 + q * q) * np.sqrt(square),
            turns_rad=np.arctan2(q, p),
            hollows_per_mm=hollows_per_mm,
            lens=lens,
        )

    def tips_mm(self, radius_mm: float) -> Array:
        """Return heights of a ball's tip over the lens and one radius around it, on a grid as fine as ball and samples
        need.

        The highest of lens and ball above each place: low by what both bend between two places, micrometres.
        """
        return _tips_mm(self, radius_mm)

    def lowest_tip_mm(self, radius_mm: float) -> float:
        """Return the lowest height of the ball's tip; a flat cutter of that radius stays higher."""
        return float(self.tips_mm(radius_mm).min())

    @property
    def deepest_mm(self) -> float:
        return -float(self.heights_mm[0])

    def reached_share(self, radius_mm: float) -> float:
        """Return the share of the area whose curvature a ball of this radius fits."""
        return float(np.searchsorted(self.hollows_per_mm, 1.001 / radius_mm, side="right")) / self.hollows_per_mm.size

    def tooth_slopes_rad(self, spec: PassSpec, step_mm: float) -> float:
        """Return the rms slopes that steps within moves leave along the rows. A contour hardly rises, but its few teeth
        are long: on average they count like rows in both directions (without them a plan promised 0.6 dB too much).
        """
        return _tooth_slopes_rad(self, spec.strategy, spec.direction, spec.radius_mm, step_mm)

    def bends(self, direction: Direction) -> Array:
        return self.bends_x if direction == "x" else self.bends_y

    def steepness(self, spec: PassSpec) -> float:
        """Return rms slopes that the rows of a pass leave across them, over those on a flat lens: a sloping ball is
        steeper.

        A hollow of curvature k does not change that: the contacts of its rows lie farther apart by 1 / (1 - kR), and
        ball and lens diverge between them by as much less.
        """
        return _steepness(self, spec.strategy, spec.direction)

    def widen_factor(self, spec: PassSpec, reach_mm: float) -> float:
        """Return the factor by which the grooves of a pass spread light farther than their slope errors alone, rms.

        reach_mm : how far a slope of 1 deflects light; negative if a hollow focuses it, on a mirror

        A groove has the ball's curvature, not the lens's, and is p / (1 - kR) wide: its light starts that wide, and its
        slopes add reach / R of that width.
        """
        return _widen_factor(self, spec.strategy, spec.direction, spec.radius_mm, reach_mm)

    def chords_mm(self, spec: PassSpec) -> Array:
        """Return (n,) usual distance of the vertices of a pass along its rows."""
        if spec.finishes:
            rule = finish_rule(SLOPE_ERROR_RAD, spec.radius_mm / 2)
        else:
            rule = rough_rule(spec.stock_to_leave_mm, spec.radius_mm / 2)
        return _chords_mm(self, spec.direction, spec.radius_mm, rule)

    def usual_chord_mm(self, spec: PassSpec) -> float:
        """Return the path divided by the number of vertices, to the micrometre."""
        return _usual_chord_mm(self, replace(spec, pitch_mm=spec.radius_mm))  # the same for all pitches

    def tip_ways(self, spec: PassSpec) -> Array:
        """Return (n,) path of a ball's tip along the rows over the path of its contact: small in a hollow that the ball
        just fits.
        """
        return np.asarray(np.maximum(1.0 - self.bends(spec.direction) * spec.radius_mm, 0.0))


@lru_cache(maxsize=32)  # called again for every tool of a radius
def _tips_mm(form: LensForm, radius_mm: float) -> Array:
    sides_mm = form.width_mm, form.height_mm
    side_mm = sqrt(sides_mm[0] * sides_mm[1])
    step = side_mm / min(_SAMPLES, ceil(_PLACES_A_RADIUS * side_mm / radius_mm))
    around = ceil(radius_mm / step)
    spline = form.lens.spline_with_run_out(2 * radius_mm + 2 * step)
    x, y = (step * np.arange(-2 * around, ceil(size_mm / step - 1e-9) + 2 * around + 1) for size_mm in sides_mm)
    z = spline.jets(*np.meshgrid(form.lens.x_mm[0] + x, form.lens.y_mm[0] + y))[0]
    tips = np.empty((y.size - 2 * around, x.size - 2 * around))
    dilate(z[None], step, radius_mm, -around, tips)
    return tips


def _across(form: LensForm, strategy: Strategy, direction: Direction) -> list[tuple[Array, Array]]:
    """Return steepness and bend of a lens across the rows; along X and Y alike where these follow its contours."""
    both = [(form.steep_y, form.bends_y), (form.steep_x, form.bends_x)]
    return both if strategy == "contour" else [both["xy".index(direction)]]


@lru_cache(maxsize=32)  # called again for every pitch, like the next ones
def _steepness(form: LensForm, strategy: Strategy, direction: Direction) -> float:
    return round(float(np.sqrt(np.mean([steep**2 for steep, _ in _across(form, strategy, direction)]))), 3)


@lru_cache(maxsize=32)
def _widen_factor(form: LensForm, strategy: Strategy, direction: Direction, radius_mm: float, reach_mm: float) -> float:
    own = abs(1.0 + radius_mm / reach_mm)
    wide = [
        (own * steep / np.maximum(1.0 - bends * radius_mm, _LEAST_GAP)) ** 2
        for steep, bends in _across(form, strategy, direction)
    ]
    return round(float(np.sqrt(np.mean(wide))) / _steepness(form, strategy, direction), 3)


@lru_cache(maxsize=32)
def _tooth_slopes_rad(
    form: LensForm, strategy: Strategy, direction: Direction, radius_mm: float, step_mm: float
) -> float:
    both = form.slopes_x, form.slopes_y
    slopes = np.concatenate(both) if strategy == "contour" else both["xy".index(direction)]
    return tooth_slopes_rad(slopes, radius_mm=radius_mm, step_mm=step_mm)


@lru_cache(maxsize=32)
def _usual_chord_mm(form: LensForm, spec: PassSpec) -> float:
    ways = form.tip_ways(spec)
    return round(float(ways.mean() / (ways / form.chords_mm(spec)).mean()), 3)


@lru_cache(maxsize=32)
def _stretch(form: LensForm) -> float:
    """Return the way on the surface by its length in plan."""
    return float(np.sqrt(1.0 + form.slopes**2 / 2).mean())


@lru_cache(maxsize=32)
def _chords_mm(form: LensForm, direction: Direction, radius_mm: float, rule: VertexRule) -> Array:
    bend = form.bends(direction)
    k = np.abs(bend / np.maximum(1.0 - bend * radius_mm, 0.05)) + 1e-9
    allowed = np.minimum(2.0 * rule.slope_rad / k, np.sqrt(8.0 * rule.sag_mm / k))
    return np.clip(_USED * allowed, rule.min_mm, rule.max_mm)


def slowness_s_per_mm(form: LensForm, spec: PassSpec, mill: Kinematics) -> float:
    """Time for a way on the exact surface, by its length in plan, at the places of the form."""
    return _slowness_s_per_mm(form, replace(spec, pitch_mm=spec.radius_mm), mill)  # the same for all pitches


@lru_cache(maxsize=64)
def _slowness_s_per_mm(form: LensForm, spec: PassSpec, mill: Kinematics) -> float:
    acceleration, chords = min(mill.acceleration_mm_per_s2[:2]), form.chords_mm(spec)
    speeds = np.minimum(spec.feed_mm_per_min / 60, chords * mill.lines_per_s)
    speeds = np.minimum(speeds, np.sqrt(2 * acceleration * (mill.planner_blocks - 1) * chords))
    ways = form.tip_ways(spec)
    return _stretch(form) * float((ways / speeds).mean() / ways.mean())


def reached_mm_per_min(form: LensForm, spec: PassSpec, mill: Kinematics) -> float:
    """Return the mean speed along the rows of a pass."""
    return 60 * _stretch(form) / slowness_s_per_mm(form, spec, mill)


def turn_s(spec: PassSpec, mill: Kinematics) -> float:
    """Return the time for braking into the turn between two rows and accelerating after it."""
    feed, acceleration = spec.feed_mm_per_min / 60, min(mill.acceleration_mm_per_s2[:2])
    turning = min(feed, sqrt(acceleration * spec.pitch_mm / 2))
    return (feed - turning) ** 2 / feed / acceleration


def entry_s(spec: PassSpec) -> float:
    """Return the seconds down from safe height, along a ramp into the stock, and up again."""
    return 2.0 + spec.step_down_mm / RAMP_SLOPE / (spec.plunge_mm_per_min / 60)


def finish_layers_s(form: LensForm, spec: PassSpec, depth_mm: float, mill: Kinematics) -> float:
    """Return seconds of layers parallel to the lens, where more stock stands above it than one move may take."""
    layers = ceil(depth_mm / spec.layer_mm - 1e-9) - 1
    if layers <= 0:
        return 0.0
    feed = spec.feed_mm_per_min / 60
    length_mm, across_mm = form.width_mm + 2 * spec.radius_mm, form.height_mm + 2 * spec.radius_mm
    rows = across_mm / max(spec.pitch_mm, LAYER_STRIDE * spec.radius_mm)
    return layers * rows * (length_mm / feed + feed / min(mill.acceleration_mm_per_s2[:2]))


def layers_where_s(form: LensForm, spec: PassSpec, stock_mm: Array, mill: Kinematics) -> float:
    """Return the seconds of the same layers where stock (ny, nx) of different heights stands above the lens."""
    deepest = ceil(float(stock_mm.max()) / spec.layer_mm - 1e-9)
    share = sum(float((stock_mm > number * spec.layer_mm).mean()) for number in range(1, deepest))
    return share * finish_layers_s(form, spec, 2 * spec.layer_mm, mill)
