"""The part of each wave of a picture's cosine transform that milling keeps: rows blur in one direction, contours in
all.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numba import njit

from cam.passes import PassSpec
from cam.planning.pass_time import LensForm
from cam.planning.row_slopes import RowSlopes, SlopeSpread
from optics.heightfield import Array

_DIRECTIONS = 16
_STEPS = 128  # nodes between which the remaining part of a wave is interpolated linearly
_BLOCK = 4  # waves along a side of a block, for which contours keep the same part
_SHARPENING = 4.0  # Landweber steps that non-negative light allows on average


@dataclass(frozen=True, kw_only=True, eq=False)
class Waves:
    """The waves of pictures of one size on one screen.

    along_y (ny,), along_x (nx,) : periods to a mm
    """

    along_y: Array
    along_x: Array

    @classmethod
    def of(cls, shape: tuple[int, int], pixel_mm: tuple[float, float]) -> Waves:
        """shape, pixel_mm: rows and columns; y, x."""
        y, x = (np.arange(count) / (2 * count * size) for count, size in zip(shape, pixel_mm, strict=True))
        return cls(along_y=y, along_x=x)

    @cached_property
    def by_blocks(self) -> Waves:
        """Return waves with one wave for each block of these."""
        ny, nx = (one.size // _BLOCK * _BLOCK for one in (self.along_y, self.along_x))
        return Waves(along_y=self.along_y[:ny:_BLOCK], along_x=self.along_x[:nx:_BLOCK])

    def block_sums(self, values: Array) -> Array:
        """Return block sums of values (ny, nx), one for each wave of `by_blocks`."""
        ny, nx = (count // _BLOCK for count in values.shape)
        whole = values[: ny * _BLOCK, : nx * _BLOCK]
        return np.asarray(whole.reshape(ny, _BLOCK, nx, _BLOCK).sum(axis=(1, 3)))

    def compute_kept(self, form: LensForm, slopes: RowSlopes, spec: PassSpec, reach_mm: float) -> Array:
        """Return (ny, nx) the remaining part of each wave if a slope of 1 deflects light by `reach_mm`."""
        if spec.strategy == "contour":
            return self.compute_kept_by_contours(form, slopes, reach_mm)[0]
        over_y, over_x = yx_spreads(slopes, spec)
        left = over_y.transfer(self.along_y, reach_mm), over_x.transfer(self.along_x, reach_mm)
        return np.outer(*left)

    def compute_kept_by_contours(self, form: LensForm, slopes: RowSlopes, reach_mm: float) -> tuple[Array, Array]:
        """Return the remaining part of each wave, and of its square. Rows run along the contour lines: the direction
        across them is that of the gradient at each place, and the direction along them is a quarter turn from it.
        """
        waves = np.linspace(0.0, float(np.hypot(self.along_x[-1], self.along_y[-1])), _STEPS)
        across, along = (spread.transfer(waves, reach_mm) for spread in (slopes.across, slopes.along))
        kept, squared = (np.empty((self.along_y.size, self.along_x.size)) for _ in range(2))
        _keep_by_contours(self.along_y, self.along_x, _share_by_turn(form), across, along, waves[1], kept, squared)
        return kept, squared


@lru_cache(maxsize=32)
def _share_by_turn(form: LensForm) -> Array:
    """Return (n, 3) cosine and sine of n directions in half a turn, and the share of places with that gradient
    direction.
    """
    turns = np.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    share = np.histogram(np.mod(form.turns_rad, np.pi), _DIRECTIONS, range=(0.0, np.pi))[0] / form.turns_rad.size
    return np.column_stack([np.cos(turns), np.sin(turns), share])


@njit(cache=True, nogil=True)
def _keep_by_contours(along_y, along_x, turns, across, along, step, kept, squared):  # type: ignore[no-untyped-def]
    """Compute kept and squared (ny, nx), for waves without a sign; across, along (k,): parts left of waves one step
    apart.
    """
    for j in range(along_y.size):
        for i in range(along_x.size):
            total = square = 0.0
            for d in range(turns.shape[0]):
                cosine, sine, share = turns[d]
                for up in (along_y[j], -along_y[j]):
                    uphill = abs(cosine * along_x[i] + sine * up) / step
                    level = abs(sine * along_x[i] - cosine * up) / step
                    left = _between(across, uphill) * _between(along, level)
                    total += 0.5 * share * left
                    square += 0.5 * share * left * left
            kept[j, i], squared[j, i] = total, square


@njit(cache=True, nogil=True, inline="always")
def _between(values, place):  # type: ignore[no-untyped-def]
    first = min(int(place), values.size - 2)
    return values[first] + (place - first) * (values[first + 1] - values[first])


def yx_spreads(slopes: RowSlopes, spec: PassSpec) -> tuple[SlopeSpread, SlopeSpread]:
    """Return the slope errors of rows along Y and along X; if rows run along contours, twice those across them."""
    if spec.strategy == "contour":
        return slopes.across, slopes.across
    return (slopes.across, slopes.along) if spec.direction == "x" else (slopes.along, slopes.across)


def compute_lost_when_sharpened(kept: Array) -> Array:
    """Return the part of each wave missing in the end, when the lens is sharpened as far as light allows."""
    return np.asarray((1.0 - kept) * np.clip(1.0 - kept * kept, 0.0, 1.0) ** _SHARPENING)
