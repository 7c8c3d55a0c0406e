"""Slope errors that milled rows leave on a surface, from ball, pitch, steps and noise alone.

Each row leaves a cylinder of the ball's radius, off in height by its own error d, and the surface is the lowest of all:
min over i of d_i + (y - y_i)^2 / 2R (reference: paper, Fig. 15). Without errors that is the scallop, slopes even in
+-p / 2R. With errors, only the deepest rows leave a trace: facets are then about sqrt(8 R sigma) wide however close the
rows are, so slopes go as sqrt(sigma / R), and only a larger ball helps.

Heights are off by the mill's noise, one figure a row, and by its steps: targets are whole steps, so a vertex is off by
up to half of one, and the chord to the next vertex off in slope by the difference over its length. Little of both
remains for vertices that `cam.rows.rounding` places where the path crosses whole steps. Within a move the axis also
climbs a slope in whole steps, and the ball leaves a tooth for each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import hypot, sqrt

import numpy as np
from numba import njit

from optics.heightfield import Array

_ROWS = 6000
_BINS = 257
_PLACES_A_ROW = 8
_SEED = 20140301
_LOTS = 0.3  # fits `cam.as_milled`: chords of one row follow one another, and their light is wider than a point
_CHOSEN_ROWS, _CHOSEN_CHORDS = (
    0.09,
    0.07,
)  # of the errors, where `cam.rows.rounding` puts vertices on whole steps of 2 um:
# rows on a lens with slopes of 0.22 rms, balls of 1 and 6 mm, are off by 0.05 um and 0.5 mrad rms
_HIDDEN = 0.53  # fits the facets of `cam.as_milled` within 15 % for balls of 0.5 to 6 mm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlopeSpread:
    """How slope errors along one direction are distributed: slope (n,) and the share of the area (n,), of sum 1.

    It is symmetric: slopes rise evenly through 0 in the middle, n is odd.
    """

    slope: Array
    share: Array

    @property
    def rms(self) -> float:
        return float(np.sqrt((self.share * self.slope**2).sum()))

    def times(self, steepness: float) -> SlopeSpread:
        return SlopeSpread(slope=steepness * self.slope, share=self.share)

    def transfer(self, waves: Array, reach: float) -> Array:
        """Return the remaining part of a wave of the picture if slope s deflects light by `reach` x s: the mean of cos.

        waves : (k,) per unit of reach x slope
        """
        half = self.slope.size // 2
        step = 2 * np.pi * reach * self.slope[-1] / max(half, 1)
        return _mean_cosine(np.asarray(waves) * step, self.share[half:])

    def compute_share_inside(self, places_mm: Array, end_mm: float, reach_mm: float) -> Array:
        """Return (n,) share of the usual light at places between 0 and end_mm, with darkness beyond both ends."""
        sent = np.concatenate([[0.0], np.cumsum(self.share)])
        over = [1.0 - sent[np.searchsorted(self.slope * reach_mm, d)] for d in (places_mm, end_mm - places_mm)]
        return np.asarray(1.0 - over[0] - over[1])


@njit(cache=True, nogil=True)
def _mean_cosine(steps: Array, share: Array) -> Array:
    """Return (k,) of each step the mean of cos(i step) by shares (m,), those but the first counted for -i as well.

    By cos((i + 1) a) = 2 cos(a) cos(i a) - cos((i - 1) a).
    """
    out = np.full(steps.size, share[0])
    for k in range(steps.size):
        cosine = np.cos(steps[k])
        before, now = 1.0, cosine
        for i in range(1, share.size):
            out[k] += 2.0 * share[i] * now
            before, now = now, 2.0 * cosine * now - before
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RowSlopes:
    """Slope errors across the rows and along them, those of whole chords among these (rms); the rows' own errors of
    height (standard deviation); the usual distance of vertices along a row."""

    across: SlopeSpread
    along: SlopeSpread
    chord_rad: float = 0.0
    off_mm: float = 0.0
    vertex_mm: float = 0.1


def row_slopes(
    *,
    radius_mm: float,
    pitch_mm: float,
    step_mm: float,
    noise_mm: float,
    vertex_mm: float,
    whole_steps: bool = False,
    steepness: float = 1.0,
    tooth_rad: float = 0.0,
) -> RowSlopes:
    """Return the slope errors of the rows of one pass.

    step_mm     : smallest move of the mill's axes
    noise_mm    : sigma of the height error from row to row
    vertex_mm   : usual distance of the vertices along a row
    whole_steps : vertices are placed where the path crosses whole steps, as far as it does
    steepness   : of slopes across the rows, over those on a flat lens
    tooth_rad   : rms of the slopes that steps within moves leave along the rows: `tooth_slopes_rad`
    """
    left_of_rows, left_of_chords = (_CHOSEN_ROWS, _CHOSEN_CHORDS) if whole_steps else (1.0, 1.0)
    step_off_mm = left_of_rows * step_mm / sqrt(12)
    off_mm = sqrt(noise_mm**2 + step_off_mm**2)
    chord = left_of_chords * step_mm / (sqrt(6) * vertex_mm)
    hidden = _HIDDEN * sqrt(2 * step_off_mm / radius_mm)  # shorter dents, which the ball cannot enter, leave no more
    chord_rad = chord * hidden / sqrt(chord**2 + hidden**2) if chord > 0 else 0.0
    return RowSlopes(
        across=_across(radius_mm, pitch_mm, off_mm).times(steepness),
        along=_along(hypot(chord_rad, tooth_rad)),
        chord_rad=chord_rad,
        off_mm=off_mm,
        vertex_mm=vertex_mm,
    )


def tooth_slopes_rad(slopes: Array, *, radius_mm: float, step_mm: float) -> float:
    """Return the rms slopes along rows that go up `slopes` (n,) by whole steps, each a tooth s / m long.

    The ball leaves slopes even in +-s / 2mR; on the longest teeth only over the sqrt(2Rs) in which it comes down a
    step. Neighbouring rows hide a little of it: `cam.as_milled` agrees within a fifth, for balls of 0.5 to 6 mm, steps
    of 0.5 to 4 um and pitches of 0.02 to 0.2 mm.
    """
    if step_mm <= 0:
        return 0.0
    tooth_mm = step_mm / np.maximum(np.abs(slopes), 1e-6)
    down_mm = sqrt(2 * radius_mm * step_mm)
    long = np.maximum(down_mm**3 / (3 * radius_mm**2 * tooth_mm) - (step_mm / tooth_mm) ** 2, 0.0)
    return float(np.sqrt(np.where(tooth_mm < down_mm, tooth_mm**2 / (12 * radius_mm**2), long).mean()))


def even_slopes(*, radius_mm: float, pitch_mm: float) -> SlopeSpread:
    """Return the scallops of a mill without errors: even in +-p / 2R."""
    slope = (np.arange(_BINS) - _BINS // 2) / (_BINS / 2) * pitch_mm / (2 * radius_mm)
    return SlopeSpread(slope=slope, share=np.full(_BINS, 1 / _BINS))


@lru_cache(maxsize=512)
def _across(radius_mm: float, pitch_mm: float, off_mm: float) -> SlopeSpread:
    """Return slopes across rows, with heights in p^2 / R and slopes in p / R: in these units they depend on one
    number.
    """
    if off_mm < 1e-3 * pitch_mm**2 / radius_mm:
        return even_slopes(radius_mm=radius_mm, pitch_mm=pitch_mm)
    _, low, high = _facets(radius_mm, pitch_mm, off_mm)
    share, edges = _histogram(low, high)
    return SlopeSpread(slope=(edges[:-1] + edges[1:]) / 2 * pitch_mm / radius_mm, share=share)


@lru_cache(maxsize=128)
def _facets(radius_mm: float, pitch_mm: float, off_mm: float) -> tuple[Array, Array, Array]:
    """Return rows (k,) that leave a trace, and its borders from the row, all in pitches."""
    unit_mm = pitch_mm**2 / radius_mm
    width = sqrt(8 * off_mm / unit_mm)  # of a facet
    count = int(min(60 * _ROWS, _ROWS * max(1.0, width / 2)))
    rows, borders = lowest_rows(np.random.default_rng(_SEED).normal(0.0, off_mm / unit_mm, count))
    inner = slice(*np.searchsorted(rows, (1 + 2 * width, count - 2 - 2 * width)))  # the outermost reach far out
    return rows[inner], borders[:-1][inner] - rows[inner], borders[1:][inner] - rows[inner]


def row_profile(radius_mm: float, pitch_mm: float, off_mm: float, *, length_mm: float = 120.0) -> tuple[Array, float]:
    """Return heights across rows (n,), mean 0, and their spacing: the lowest of all rows, each off by its own error."""
    count = int(length_mm / pitch_mm)
    unit_mm = pitch_mm**2 / radius_mm
    off_by_row = np.random.default_rng(_SEED).normal(0.0, off_mm, count)
    rows, borders = lowest_rows(off_by_row / unit_mm)
    at = (np.arange(count * _PLACES_A_ROW) + 0.5) / _PLACES_A_ROW
    nearest = rows[np.clip(np.searchsorted(borders, at) - 1, 0, rows.size - 1)]
    heights = off_by_row[nearest.astype(int)] + unit_mm * np.square(at - nearest) / 2
    return heights - heights.mean(), pitch_mm / _PLACES_A_ROW


@lru_cache(maxsize=4096)
def row_grain(radius_mm: float, pitch_mm: float, off_mm: float, reach_mm: float, pixel_mm: float) -> float:
    """Return the standard deviation of the light on a pixel over its mean, across rows whose heights are off.

    Each facet spreads its light evenly over 1 + reach / R of its own width, so few facets light one place, the fewer
    the larger the ball; where their widths differ they make stripes.
    """
    rows, low, high = _facets(radius_mm, pitch_mm, off_mm)
    spread = 1.0 + reach_mm / radius_mm
    begin, end = (rows + low * spread) * pitch_mm, (rows + high * spread) * pitch_mm
    edge = float((high - low).max()) * spread * pitch_mm
    edges = np.arange(rows[0] * pitch_mm + edge, rows[-1] * pitch_mm - edge, pixel_mm)
    if edges.size < 50:
        return 0.0
    light = np.diff(_sum_passed(begin, edges) - _sum_passed(end, edges))
    return float(light.std() / light.mean())


def chord_grain(slopes: RowSlopes, *, radius_mm: float, reach_mm: float, pixel_mm: float) -> float:
    """Return the same along the rows: each chord with a slope error deflects its whole light at random, so the number
    of chords that light a pixel varies like a random count. About 1 + reach / R rows light each place.
    """
    aside = slopes.chord_rad * reach_mm / slopes.vertex_mm
    chords = (1.0 + reach_mm / radius_mm) * pixel_mm / slopes.vertex_mm
    return sqrt(_LOTS * aside**2 / (1.0 + aside**2) / chords)


def _sum_passed(places: Array, edges: Array) -> Array:
    """Return, for each place, the sum of the distances by which edges lie beyond it."""
    ordered = np.sort(places)
    before = np.searchsorted(ordered, edges)
    return np.asarray(before * edges - np.concatenate([[0.0], np.cumsum(ordered)])[before])


def _histogram(low: Array, high: Array) -> tuple[Array, Array]:
    """Return the shares of slopes of facets that are even from low to high; symmetric, as its law is."""
    most = float(max(-low.min(), high.max()))
    edges = np.linspace(-most, most, _BINS + 1)
    share = np.diff(_sum_passed(low, edges) - _sum_passed(high, edges))
    share = (share + share[::-1]) / 2
    return share / share.sum(), edges


def _along(rms: float) -> SlopeSpread:
    """Return the difference of two heights, each even within half a step: a triangle."""
    if rms <= 0:
        return SlopeSpread(slope=np.zeros(1), share=np.ones(1))
    most = rms * sqrt(6)
    slope = (np.arange(_BINS) - _BINS // 2) / (_BINS // 2) * most
    share = most - np.abs(slope)
    return SlopeSpread(slope=slope, share=share / share.sum())


@njit(cache=True, nogil=True)
def lowest_rows(off: Array) -> tuple[Array, Array]:
    """Lower envelope of off[i] + (y - i)^2 / 2: rows (k,) that are seen in it, and the borders (k + 1,) between them.

    Felzenszwalb and Huttenlocher, linear time.
    """
    n = off.size
    at = np.empty(n)
    start = np.empty(n + 1)
    k = 0
    at[0], start[0], start[1] = 0.0, -np.inf, np.inf
    for i in range(1, n):
        while True:
            j = int(at[k])
            s = (off[i] - off[j]) / (i - j) + 0.5 * (i + j)
            if s > start[k]:
                break
            k -= 1
        k += 1
        at[k], start[k], start[k + 1] = i, s, np.inf
    return at[: k + 1].copy(), start[: k + 2].copy()
