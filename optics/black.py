"""Finds the parts of a picture that are hard for a lens before the lens is designed (black areas, fine strokes, single
dots), and advises remedies.

Lenses make black by creases. On the direct branch these are valleys, and a ball of radius r leaves their bottoms round:
a bottom of curvature 1/r spreads its light by m + k H / r instead of by M (M: screen over aperture; m: the spread by a
flat surface, 1 for parallel light; H: throw; k = n - 1, or 2 for a mirror), so that black receives M / (m + k H / r) of
the mean irradiance. On the inverted branch ridges make black, and any ball can cut them; there the rays cross
before the screen, which takes steeper slopes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from optics.bench import Bench, Branch
from optics.errors import OpticsError
from optics.outline import share_notched
from optics.spline import Array
from optics.transport.grid_levels import average_boxes
from optics.transport.solver import solve_transport
from phrases.phrase import Phrase

DARK = 0.02  # of the brightest pixel: below is black
_LEAK_WORTH_A_WORD = 0.01
_LEAK_WORTH_A_TURN = 0.01
_FINE_WORTH_A_WORD = 0.2  # below, nearly all of 200 hard pictures of 64-128 had less than 3 % of light misplaced
_MISPLACED_PER_FINE = 0.3  # measured on these pictures at 2 vertices a pixel and 2 corrections
_PEAK_WORTH_A_WORD = 100.0  # times the mean
_SKETCH_PIXELS = 48
_SPARE_MM = 2.0  # of the block's thickness, under the deepest point
STEEPEST = 0.7  # slope that leaves room under total reflection (0.905 for 1.49)


@dataclass(frozen=True, slots=True)
class Advice:
    """Advice about a lens, with the values to change.

    figures : of this very lens; those of a coarse lens are only a first guess, so only its words are shown
    """

    words: Phrase
    figures: Phrase | None = None

    def sentence(self) -> Phrase:
        """Return the words with the figures."""
        if self.figures is None:
            return self.words
        return Phrase("{words} ({figures})", words=self.words, figures=self.figures)


def dark_leak_estimate(target: Array, bench: Bench, radius_mm: float) -> float:
    """Return the share of light that falls on black pixels with any method, for valleys with a ball's radius.

    target (ny, nx), mean 1. The picture's own light on its black pixels counts too. The lens grid adds to it: 0.5-1 %
    of the light for a logo at two vertices a pixel, a third of that at eight.
    """
    dark = target < DARK * target.max()
    in_valley = valley_leak(bench, radius_mm) * float(target.mean())
    return float(np.maximum(target[dark], in_valley).sum() / target.sum())


def valley_leak(bench: Bench, radius_mm: float) -> float:
    """Return the light in a valley for a ball of that radius, as a share of the mean irradiance; zero without a ball,
    or if black comes from ridges.
    """
    if bench.branch == "inverted" or radius_mm <= 0:
        return 0.0
    s = bench.screen
    spread = math.sqrt(s.width_mm * s.height_mm / (bench.width_mm * bench.height_mm))
    bending = 2.0 if bench.mirror else bench.refractive_index - 1
    return spread / (_flat_spread(bench) + bending * bench.throw_mm / radius_mm)


def _flat_spread(bench: Bench) -> float:
    """Return the factor by which a flat surface enlarges the aperture's patch of light, near the axis."""
    if not bench.light.is_point:
        return 1.0
    glass_mm = 0.0 if bench.mirror else bench.thickness_mm / bench.refractive_index
    return 1.0 + bench.throw_mm / (bench.light.distance_mm + glass_mm)


def fine_detail(target: Array) -> float:
    """Return the share of light that a blur over 3 x 3 pixels would move: 0 for a soft picture, 1 for separate dots."""
    return float(np.abs(target - uniform_filter(target, 3, mode="nearest")).mean() / (2 * target.mean()))


def find_advice(target: Array, bench: Bench, radius_mm: float, *, vertices_per_pixel: int = 2) -> tuple[Advice, ...]:
    """Return advice for a picture that is hard for this set-up: what to expect and what to change. Most pictures need
    none.
    """
    found = []
    leak, fine, peak = dark_leak_estimate(target, bench, radius_mm), fine_detail(target), target.max() / target.mean()
    if leak - dark_leak_estimate(target, bench, 0.0) >= _LEAK_WORTH_A_WORD:
        figures = Phrase(
            "black covers {black_percent:.0f} % of the picture; in valleys for a ball of radius {radius_mm:g} mm, "
            "Ø {diameter_mm:g}, about {percent:.1f} % of the light ends there",
            black_percent=100 * np.mean(target < DARK * target.max()),
            radius_mm=radius_mm,
            diameter_mm=2 * radius_mm,
            percent=100 * leak,
        )
        found.append(Advice(_describe_black(target, bench, radius_mm), figures))
    if fine >= _FINE_WORTH_A_WORD:
        found.append(Advice(_describe_fine(fine, vertices_per_pixel)))
    if peak >= _PEAK_WORTH_A_WORD:
        found.append(
            Advice(
                Phrase(
                    "the brightest pixel needs {times:.0f} times the mean, more than a lens of this grid can "
                    "focus; larger spots or a floor of grey under the picture (a hundredth of its white) help",
                    times=peak,
                )
            )
        )
    if notched := share_notched(bench):
        found.append(
            Advice(
                Phrase(
                    "the outline leaves out {percent:.0f} % of its convex hull: the picture's frame gets its light "
                    "from beside the notches too, and with it dark and bright lines; a convex outline has none",
                    percent=100 * notched,
                )
            )
        )
    return tuple(found)


def _describe_black(target: Array, bench: Bench, radius_mm: float) -> Phrase:
    if choose_branch(target, bench, radius_mm) == bench.branch:
        return Phrase(
            "black will not be quite dark: a ball of half the radius or a wall twice as far away halves the light in it"
        )
    return Phrase(
        "black will not be quite dark: a ball of half the radius or a wall twice as far away halves the light in it, "
        "and the inverted branch avoids it"
    )


def _describe_fine(fine: float, vertices_per_pixel: int) -> Phrase:
    percent, beside_percent = 100 * fine, 100 * _MISPLACED_PER_FINE * fine
    if vertices_per_pixel < 4:
        return Phrase(
            "{percent:.0f} % of the light is in detail of a pixel or two (thin strokes, dots, noise): about "
            "{beside_percent:.0f} % of it will fall beside its place; thicker strokes, more pixels for the same "
            "detail, a finer lens grid (vertices per pixel) or grey instead of black help",
            percent=percent,
            beside_percent=beside_percent,
        )
    return Phrase(
        "{percent:.0f} % of the light is in detail of a pixel or two (thin strokes, dots, noise): about "
        "{beside_percent:.0f} % of it will fall beside its place; thicker strokes, more pixels for the same detail or "
        "grey instead of black help",
        percent=percent,
        beside_percent=beside_percent,
    )


def choose_branch(target: Array, bench: Bench, radius_mm: float, *, steepest: float = STEEPEST) -> Branch:
    """Return the inverted branch if it makes black areas darker and a coarse design of it converges, is no steeper, and
    fits.

    At a throw of three times the width (logo, 256 pixels, ball of 2 mm) 1.7 instead of 2.7 % of the light ends in
    black, for a relief of 25 instead of 8 mm; nearer, slopes come too close to total reflection.
    """
    direct, inverted = replace(bench, branch="direct"), replace(bench, branch="inverted")
    gain = dark_leak_estimate(target, direct, radius_mm) - dark_leak_estimate(target, inverted, radius_mm)
    if gain < _LEAK_WORTH_A_TURN:
        return "direct"
    try:
        slope, relief_mm = _sketch_slopes(target, inverted)
    except OpticsError:
        return "direct"
    fits = relief_mm + _SPARE_MM <= bench.thickness_mm
    return "inverted" if slope <= steepest and fits else "direct"


def _sketch_slopes(target: Array, bench: Bench) -> tuple[float, float]:
    """Return (steepest slope, relief in mm) of a coarse lens; infinite if none converges."""
    ny, nx = (min(n, _SKETCH_PIXELS) for n in target.shape)
    path = solve_transport(average_boxes(target, (ny, nx)), bench, skim_mm=0.0, tolerance=1e-2)
    if not path.converged:
        return math.inf, math.inf
    x_mm, y_mm = np.linspace(0.0, bench.width_mm, nx + 1), np.linspace(0.0, bench.height_mm, ny + 1)
    z_mm = path.heights_mm(x_mm, y_mm)
    along, across = np.gradient(z_mm, y_mm, x_mm)
    return float(np.hypot(across, along).max()), float(np.ptp(z_mm))
