"""The mean effect of milling on a picture: how far its facets deflect light from the lens's intended point.

Computes, from samples of the milled surface, the blur in pixels, and a predicted picture within a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from optics.bench import Bench
from optics.caustic import aim_at
from optics.convolution import convolve_same
from optics.heightfield import Heightfield
from optics.light import Beam, leave, meet
from optics.milled import polygon_area, spread_polygon
from optics.spline import Array
from optics.tubes.lattice import Aim

_INNER = 0.5 / math.sqrt(3.0)  # Gauss points of a facet, from its middle, of its side
_ENOUGH = 20_000  # slopes of a sample, enough for their distribution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Deviations:
    """Deviations of a milled surface from its lens: rms of slopes, and of the places where light arrives; x, y and
    both.

    slopes (about n, 2) : errors of slopes, each the mean over an equal part of the area. Parts are divided by their
                          slope in x, each of these by that in y, and more finely where slopes differ more
    """

    slope_x_mrad: float
    slope_y_mrad: float
    blur_x_px: float
    blur_y_px: float
    slopes: Array

    @property
    def slope_mrad(self) -> float:
        return math.hypot(self.slope_x_mrad, self.slope_y_mrad)

    @property
    def blur_px(self) -> float:
        return math.hypot(self.blur_x_px, self.blur_y_px)


def deviations(
    samples: Iterable[Array], heightfield: Heightfield, bench: Bench, pixels: tuple[int, int], *, slopes: int = 1
) -> Deviations:
    """Return the deviations of facets (n, 4, 5), with about `count` of their slopes; facets beyond the aperture do not
    count.
    """
    aim, beam = aim_at(bench, pixels), bench.beam()
    sums, area = np.zeros(4), 0.0
    random, found = np.random.default_rng(0), [np.empty((0, 3))]
    for points, jets, weight in _points_of(samples, heightfield):
        off = points[:, 3:] - jets[1:3].T
        sums += np.nansum(weight * np.concatenate([off.T, _throw(points, jets, beam, aim)]) ** 2, axis=1)
        area += float(weight.sum())
        rows = np.column_stack([off, weight])
        found.append(rows if len(rows) <= _ENOUGH else random.choice(rows, _ENOUGH, replace=False))
    slope_x, slope_y, blur_x, blur_y = np.sqrt(sums / max(area, 1e-300))
    return Deviations(
        slope_x_mrad=1e3 * float(slope_x),
        slope_y_mrad=1e3 * float(slope_y),
        blur_x_px=float(blur_x),
        blur_y_px=float(blur_y),
        slopes=_means_of_parts(np.concatenate(found), slopes),
    )


def _means_of_parts(rows: Array, count: int) -> Array:
    """Return (about count, 2) means of slopes in rows (n, 3) of slopes and areas, see `Deviations`."""
    if not rows[:, 2].any():
        return np.zeros((1, 2))
    spread = np.sqrt(np.average(rows[:, :2] ** 2, axis=0, weights=rows[:, 2])) + 1e-12
    across = int(np.clip(round(math.sqrt(count * spread[0] / spread[1])), 1, count))
    strips = _divide(rows, 0, across)
    parts = [part for strip in strips for part in _divide(strip, 1, max(1, count // across))]
    return np.array([np.average(part[:, :2], axis=0, weights=part[:, 2]) for part in parts])


def _divide(rows: Array, axis: int, count: int) -> list[Array]:
    """Return rows in order along an axis, as parts of about the same weight (the last column); none is empty."""
    ordered = rows[np.argsort(rows[:, axis], kind="stable")]
    before = np.cumsum(ordered[:, 2]) - 0.5 * ordered[:, 2]
    ends = np.searchsorted(before, np.arange(1, count) / count * ordered[:, 2].sum())
    return [part for part in np.split(ordered, ends) if len(part)]


def _points_of(samples: Iterable[Array], heightfield: Heightfield) -> Iterator[tuple[Array, Array, Array]]:
    """Yield Gauss points (n, 5) of the facets within the aperture, the lens's jets (6, n) there, and areas (n,)."""
    spline, size = heightfield.spline(), (heightfield.width_mm, heightfield.height_mm)
    for facets in samples:
        middle = facets[:, :, :2].mean(axis=1)
        chosen = facets[((middle > 0.0) & (middle < size)).all(axis=1)]
        weight = _areas(chosen)
        for u in (-_INNER, _INNER):
            for v in (-_INNER, _INNER):
                shares = ((0.5 - u) * (0.5 - v), (0.5 + u) * (0.5 - v), (0.5 + u) * (0.5 + v), (0.5 - u) * (0.5 + v))
                points = np.einsum("nkd,k->nd", chosen, np.array(shares))
                yield points, spline.jets(points[:, 0], points[:, 1]), weight


def _areas(facets: Array) -> Array:
    """Return (n,) in plan."""
    x, y = facets[:, :, 0], facets[:, :, 1]
    return np.abs((x[:, 2] - x[:, 0]) * (y[:, 3] - y[:, 1]) - (x[:, 3] - x[:, 1]) * (y[:, 2] - y[:, 0])) / 2


def predict_light(irradiance: Array, samples: Sequence[Array], heightfield: Heightfield, bench: Bench) -> Array:
    """Return the design's light (ny, nx) as a surface like the samples would show it; takes a second instead of a
    minute.

    samples : (n, 4, 5) facets each, of some squares of the milled surface. Their deflection of light relative to the
    lens gives the blur kernel, the same everywhere; their effect on even light gives grain and stripes, repeated over
    the picture. In a spot I times as bright as the mean, light of I times as many grooves meets, so the grain grows as
    sqrt(I).
    """
    shape = (irradiance.shape[0], irradiance.shape[1])
    aim, beam, spline = aim_at(bench, shape), bench.beam(), heightfield.spline()
    samples, thrown = [facets for facets in samples if len(facets)], []
    for facets in samples:
        jets = spline.jets(*facets[:, :, :2].mean(axis=1).T).repeat(4, axis=1)  # of the lens at the facet's middle
        thrown.append(_throw(facets.reshape(-1, 5), jets, beam, aim).reshape(2, -1, 4))
    reaches = [np.abs(one[np.isfinite(one)]) for one in thrown]
    far = max((float(np.quantile(one, 0.999)) for one in reaches if one.size), default=math.nan)
    if math.isnan(far):  # no usable samples
        return irradiance.copy()
    kernel = _kernel(samples, thrown, min(math.ceil(far) + 1, max(shape)))
    blurred = convolve_same(irradiance, kernel)
    grain = _grain(samples, thrown, math.ceil(far) + 1, aim, shape)
    return np.asarray(blurred + grain * np.sqrt(np.clip(blurred, 0.0, None) * blurred.mean()))


def _kernel(samples: Sequence[Array], thrown: Sequence[Array], far: int) -> Array:
    """Return (2 far + 1, 2 far + 1) weights of sum 1: the spread of the light of one point of the picture."""
    acc = np.zeros((2 * far + 1, 2 * far + 2))
    for facets, way in zip(samples, thrown, strict=True):
        _paint_thrown(facets, way + (far + 0.5), acc)
    kernel = np.cumsum(acc, axis=1)[:, :-1]
    return np.asarray(kernel / kernel.sum())


def _grain(samples: Sequence[Array], thrown: Sequence[Array], far: int, aim: Aim, shape: tuple[int, int]) -> Array:
    """Return (ny, nx) the relative deviation of even light through the samples, mirrored repeatedly to fill the
    picture.
    """
    tiles = []
    for facets, way in zip(samples, thrown, strict=True):
        at = np.stack([facets[:, :, 0] * aim.per_mm_x, facets[:, :, 1] * aim.per_mm_y])
        low, high = (np.quantile(at.reshape(2, -1), share, axis=1) for share in (0.001, 0.999))
        nx, ny = (int(side) for side in high - low)
        rim = min(far, (min(nx, ny) - 8) // 2)
        if rim < 1:
            continue
        acc = np.zeros((ny, nx + 1))
        _paint_thrown(facets, at + way - low[:, None, None], acc)
        tile = np.cumsum(acc, axis=1)[rim : ny - rim, rim : nx - rim]
        tiles.append(tile / tile.mean() - 1.0)
    if not tiles:
        return np.zeros(shape)
    ny, nx = (min(tile.shape[axis] for tile in tiles) for axis in (0, 1))
    block = np.concatenate([tile[:ny, :nx] for tile in tiles], axis=1)
    pad = ((0, max(0, shape[0] - block.shape[0])), (0, max(0, shape[1] - block.shape[1])))
    return np.asarray(np.pad(block, pad, mode="symmetric")[: shape[0], : shape[1]])


@njit(cache=True, nogil=True)
def _throw(corners: Array, jets: Array, beam: Beam, aim: Aim) -> Array:
    """Return (2, n) the deviation [pixels] of each corner's light from the point to which the lens would send it."""
    out = np.empty((2, corners.shape[0]))
    for k in range(corners.shape[0]):
        x, y, z = corners[k, 0], corners[k, 1], corners[k, 2]
        dx, dy, dz, _, _, _ = meet(beam, x, y, z)
        tx, ty, tz = leave(dx, dy, dz, corners[k, 3], corners[k, 4], beam.refractive_index, beam.is_mirror)
        sx, sy, sz = leave(dx, dy, dz, jets[1, k], jets[2, k], beam.refractive_index, beam.is_mirror)
        out[0, k] = (aim.throw - z) * (tx / tz - sx / sz) * aim.per_mm_x
        out[1, k] = (aim.throw - z) * (ty / tz - sy / sz) * aim.per_mm_y
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _paint_thrown(facets: Array, at: Array, acc: Array) -> None:
    """Spread each facet's area on the lens as light over the polygon at[:, f] (2, n, 4) [pixels]."""
    for f in range(facets.shape[0]):
        light = abs(polygon_area(facets[f, :, 0], facets[f, :, 1], 4))
        spread_polygon(acc, at[0, f].copy(), at[1, f].copy(), 4, light)
