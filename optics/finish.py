"""The effect of finishing by hand on a milled surface: a low pass on its heights, as far as the tool touches it.

z_finished(k) = H(k) z_milled(k) - depth with H(k) = exp(-(k / k0)^order), k in rad/mm. Sanding between grits is
diffusion (order 2), a soft pad removes in proportion to its pressure (Preston; order 1), a film of lacquer levels under
its surface tension (Orchard; order 4). H holds for marks; the form of a lens, millimetres high over centimetres, is
longer than the hand tool, which follows it: where a pad would have to take off more than its own depth it only loses
contact. So waves much longer than the tool keep their height.

A film (lacquer, melt, swollen skin) wets all of the surface: the law is linear and keeps the volume, because H is 1 at
k = 0; a coat adds the same thickness everywhere. A pad or paper only takes material off: where H z - depth would lie
above z it bridges the surface, and the law is that of `optics.contact`, whose limit for small marks is H. It bridges
creases, the foot of steep walls, and the space behind rims; there it smooths nothing, however long the work takes.

A low pass needs the surface beyond its end: the lens is continued by its run-out, and the whole is mirrored at its end
(cosine transform), far enough away to have no effect. Nothing else around the lens is modelled: a pad is assumed to go
on over the run-out. The wall of a pit that the run-out does not reach, and a pad that tips over an outer edge, are not
modelled.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from optics.contact import transform, transform_back, wear_surface
from optics.heightfield import Heightfield
from optics.spline import Array, Mask

PAD_MM = 20.0
"""The usual size of a hand tool: a felt, a soft block."""

_SIGMAS = 3.0
_BEYOND = 4.0  # in reaches of the finish: how far the surface is continued before it is mirrored


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish:
    """A finishing process.

    k0_rad_per_mm : wave number at which 1/e of a mark's height is left
    order         : 1 soft pad, 2 random abrasion, 4 levelling film
    pad_mm        : size of the tool; marks much longer than it are form, which it follows
    depth_mm      : average depth that a pad or paper takes off, which decides where it touches; None: a film, or not
                    known: the linear law everywhere
    """

    k0_rad_per_mm: float
    order: float
    pad_mm: float = PAD_MM
    depth_mm: float | None = None

    def __post_init__(self) -> None:
        for name in ("k0_rad_per_mm", "order", "pad_mm", "depth_mm"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} = {value:g} must be more than 0")

    def after(self, dose: float) -> Finish:
        """Return the finish after `dose` times as much work: the exponent of its law grows with the dose."""
        depth_mm = None if self.depth_mm is None else dose * self.depth_mm
        return replace(self, k0_rad_per_mm=self.k0_rad_per_mm * dose ** (-1.0 / self.order), depth_mm=depth_mm)

    @property
    def reach_mm(self) -> float:
        """Distance from a rim, a step or the end of the cut within which the finish rounds: 3 sigma, exact for order
        2.
        """
        return _SIGMAS * math.sqrt(2.0) / self.k0_rad_per_mm

    @property
    def seen_beyond_mm(self) -> float:
        """Distance beyond the rim within which the surface affects the result, and must continue."""
        return _BEYOND * self.reach_mm

    def transfer(self, k_rad_per_mm: Array) -> Array:
        """Return H(k): the part of a mark's height that is left."""
        return np.asarray(np.exp(-((np.asarray(k_rad_per_mm) / self.k0_rad_per_mm) ** self.order)))

    def compute_kept(self, k_rad_per_mm: Array) -> Array:
        """Return the remaining part of a surface's wave: H(k), and 1 for form."""
        form = np.exp(-((np.asarray(k_rad_per_mm) * self.pad_mm / math.pi) ** 2))
        return np.asarray(form + (1.0 - form) * self.transfer(k_rad_per_mm))

    def multipliers(self, shape: tuple[int, int], spacing_mm: tuple[float, float]) -> Array:
        """Return `kept` for each wave of the cosine transform (type 1) of a grid (ny, nx) with this spacing of rows and
        columns.
        """
        down, across = (math.pi * np.arange(n) / ((n - 1) * d) for n, d in zip(shape, spacing_mm, strict=True))
        return self.compute_kept(np.hypot(down[:, None], across[None, :]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Finished:
    """A lens after its finish.

    touched : (ny, nx) vertices that the tool touches at the end of the work; all of a film
    """

    lens: Heightfield
    touched: Mask

    @property
    def contact_share(self) -> float:
        """Share of the aperture that the tool touches; 1 for a film."""
        return float(self.touched.mean())


def level(heights_mm: Array, multipliers: Array) -> Array:
    """Return heights (ny, nx) after a finish, mirrored at their ends; linear, its own transpose except at the rims."""
    return transform_back(transform(heights_mm) * multipliers, heights_mm.shape)


def finish_lens(
    lens: Heightfield,
    finish: Finish,
    *,
    departure_mm: Array | None = None,
    finer: int = 1,
    beyond_cells: int = 0,
) -> Finished:
    """Return the lens after the finish, its highest vertex unchanged, on a grid `finer` times as fine.

    departure_mm : (ny, nx) of what is milled from the lens, on that grid and beyond_cells of its cells around it
    """
    dy, dx = lens.dy_mm / finer, lens.dx_mm / finer
    least = max(math.ceil(finish.seen_beyond_mm / min(dx, dy)), beyond_cells, finer)
    ny, nx = ((axis.size - 1) * finer + 1 for axis in (lens.y_mm, lens.x_mm))
    far_y, far_x = (quick_margin(n, least) for n in (ny, nx))
    x = lens.x_mm[0] + dx * np.arange(-far_x, nx + far_x)
    y = lens.y_mm[0] + dy * np.arange(-far_y, ny + far_y)
    run_out_mm = max(far_x * dx, far_y * dy) + max(lens.dx_mm, lens.dy_mm)
    heights = lens.spline_with_run_out(run_out_mm).heights_mm(x[None, :], y[:, None])
    if departure_mm is not None:
        cut_y, cut_x = far_y - beyond_cells, far_x - beyond_cells
        heights[cut_y : y.size - cut_y, cut_x : x.size - cut_x] += departure_mm
    aperture = np.s_[far_y : far_y + ny, far_x : far_x + nx]
    kept = finish.multipliers(heights.shape, (dy, dx))
    if finish.depth_mm is None:
        done, touched = level(heights, kept), np.ones(heights.shape, dtype=np.bool_)
    else:
        worn = wear_surface(heights, kept, finish.depth_mm)
        done, touched = heights - worn.removal_mm, worn.touched
    done = done[aperture]
    surface = replace(lens, x_mm=x[aperture[1]], y_mm=y[aperture[0]], z_mm=done - done.max() + lens.z_mm.max())
    return Finished(lens=surface, touched=touched[aperture])


def surface_in_light(lens: Heightfield, finish: Finish | None) -> Heightfield:
    """Return the surface of a perfectly milled lens in the light: after its finish, if there is one."""
    return lens if finish is None else finish_lens(lens, finish).lens


def quick_margin(count: int, least: int) -> int:
    """Return the margin on either side, at least `least`, for which the transform is fast."""
    periods = ((margin, 2 * (count + 2 * margin - 1)) for margin in itertools.count(least))
    return next(margin for margin, period in periods if fft.next_fast_len(period, real=True) == period)
