"""What a polishing bob takes off a lens (`optics.bob` states its law), and the time that it has to stand at each place.

The dwell at each place is found by iteration (Richardson and Lucy) so that the depth along Z is even on the lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter, map_coordinates

from optics.bob import Bob
from optics.finish import Finish, level
from optics.heightfield import Array, Heightfield
from optics.spline import Mask

_LEAST_BEND = 0.25  # of a ball's curvature: a hollow nearly as round as the bob is no Hertzian contact
_CELLS = 8  # of the map of removal, a contact radius
_ROUNDS = 12  # of the iteration of dwell
_MOST_CHANGE = 3.0  # of a dwell, in one of them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contacts:
    """Places where a bob stands, in order.

    at_mm (n, 2)  : contact point, x and y
    tip_mm (n, 3) : the bob's tip
    dwell_s (n,)  : time at each
    """

    at_mm: Array
    tip_mm: Array
    dwell_s: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground:
    """The lens and its run-out as a bob meets it, on a square grid.

    x0_mm, y0_mm, cell_mm : node [0, 0] and spacing
    z_mm (ny, nx)         : heights; bend_per_mm (ny, nx): mean curvature over the contact, above 0 on crests
    inside (ny, nx)       : of the aperture
    """

    x0_mm: float
    y0_mm: float
    cell_mm: float
    z_mm: Array
    bend_per_mm: Array
    inside: Mask

    @classmethod
    def under(cls, bob: Bob, lens: Heightfield, *, beyond_mm: float) -> Ground:
        """Sample the lens and beyond_mm around it."""
        cell = bob.contact_mm / _CELLS
        x = np.arange(lens.x_mm[0] - beyond_mm, lens.x_mm[-1] + beyond_mm + cell, cell)
        y = np.arange(lens.y_mm[0] - beyond_mm, lens.y_mm[-1] + beyond_mm + cell, cell)
        spline = lens.spline_with_run_out(beyond_mm + 2 * cell)
        z = np.asarray(spline.heights_mm(x[None, :], y[:, None]))
        return cls(
            x0_mm=float(x[0]),
            y0_mm=float(y[0]),
            cell_mm=cell,
            z_mm=z,
            bend_per_mm=_mean_bend(gaussian_filter(z, _CELLS / 2, mode="nearest"), cell),
            inside=((y >= lens.y_mm[0]) & (y <= lens.y_mm[-1]))[:, None] & (x >= lens.x_mm[0]) & (x <= lens.x_mm[-1]),
        )

    def sample(self, values: Array, at_mm: Array) -> Array:
        """Return (n,) values of the grid at points (n, 2)."""
        places = (at_mm[:, 1] - self.y0_mm) / self.cell_mm, (at_mm[:, 0] - self.x0_mm) / self.cell_mm
        return np.asarray(map_coordinates(values, places, order=1, mode="nearest"))

    def wear(self, bob: Bob, contacts: Contacts) -> Array:
        """Return (ny, nx) what the bob takes off along Z. A worn bob is pressed less on slopes than at its tip."""
        return self._wear(bob, contacts, self.z_mm)[0]

    def plan_dwell(self, bob: Bob, contacts: Contacts, depth_mm: float, *, least_s: float = 0.0) -> Array:
        """Return (n,) dwell at each place, at least least_s, so that the depth is even on the lens and one contact
        beyond it; `contacts` has the guess.
        """
        wanted = self._grow(_CELLS)
        dwell = np.maximum(contacts.dwell_s, least_s)
        ratio = np.ones_like(self.z_mm)
        for _ in range(_ROUNDS):
            off = self._wear(bob, replace(contacts, dwell_s=dwell), ratio)[0]
            ratio = np.where(wanted, depth_mm / np.maximum(off, depth_mm / _MOST_CHANGE), 1.0)
            dwell = np.maximum(dwell * self._wear(bob, replace(contacts, dwell_s=dwell), ratio)[1], least_s)
        return dwell

    def _wear(self, bob: Bob, contacts: Contacts, values: Array) -> tuple[Array, Array]:
        """Return (ny, nx) removal, and (n,) the mean of values (ny, nx) at each place, weighted by its removal."""
        off, seen, at = np.zeros_like(self.z_mm), np.ones(len(contacts.at_mm)), contacts.at_mm
        _wear(
            *(self.z_mm, self.x0_mm, self.y0_mm, self.cell_mm, at[:, 0].copy(), at[:, 1].copy()),
            *(self.sample(self.z_mm, at), self.sample(self.bend_per_mm, at), contacts.tip_mm, contacts.dwell_s),
            *(bob.radius_mm, bob.modulus_mpa, bob.wear_per_mpa * bob.turn_rad_per_s, values, off, seen),
        )
        return off, seen

    def _grow(self, cells: int) -> Mask:
        """Return the aperture, grown by that many cells on each side."""
        rows, columns = (np.flatnonzero(self.inside.any(axis=axis)) for axis in (1, 0))
        grown = np.zeros_like(self.inside)
        low, left = max(rows[0] - cells, 0), max(columns[0] - cells, 0)
        grown[low : rows[-1] + cells + 1, left : columns[-1] + cells + 1] = True
        return grown

    def unevenness_mm(self, off_mm: Array, finish: Finish) -> Array:
        """Return (ny, nx) how much more than the planned depth comes off, as the finish leaves it: what is uneven early
        is levelled by the rest of the work, so of a wave of which H is left, (1 - H) / -ln H stays.
        """
        assert finish.depth_mm is not None
        kept = finish.multipliers(off_mm.shape, (self.cell_mm, self.cell_mm))
        rate = -np.log(np.clip(kept, 1e-300, 1.0))
        share = np.where(rate > 1e-9, -np.expm1(-rate) / np.maximum(rate, 1e-9), 1.0)
        around = np.where(self._grow(2 * _CELLS), off_mm - finish.depth_mm, 0.0)
        return level(around, share)


def _mean_bend(z: Array, cell: float) -> Array:
    """Return the mean curvature of heights (ny, nx), above 0 on crests [1/mm]."""
    zy, zx = np.gradient(z, cell)
    zyy, zxy = np.gradient(zy, cell)
    zxx = np.gradient(zx, cell, axis=1)
    steep = 1.0 + zx**2 + zy**2
    return np.asarray(-((1 + zy**2) * zxx - 2 * zx * zy * zxy + (1 + zx**2) * zyy) / (2 * steep**1.5))


@njit(cache=True, nogil=True)
def _wear(z, x0, y0, cell, px, py, pz, bend, tip, dwell, radius, modulus, wear_turn, values, off, seen):  # type: ignore[no-untyped-def]
    """Add to off (ny, nx) what comes off along Z while the bob stands at each place for its dwell; set seen (n,) to the
    mean of values (ny, nx) that each place's removal weighs.

    px, py, pz, bend (n,) : contact point and curvature there; tip (n, 3), whose centre is `radius` above it
    """
    ny, nx = z.shape
    for k in range(px.size):
        cx, cy, cz = tip[k, 0], tip[k, 1], tip[k, 2] + radius
        ux, uy, uz = cx - px[k], cy - py[k], cz - pz[k]
        away = math.sqrt(ux * ux + uy * uy + uz * uz)
        deep = radius - away
        if deep <= 0.0 or dwell[k] <= 0.0:
            continue
        ux, uy, uz = ux / away, uy / away, uz / away
        both = max(1.0 / radius + bend[k], _LEAST_BEND / radius)
        a2 = deep / both
        a = math.sqrt(a2)
        peak = 2.0 / math.pi * modulus * math.sqrt(deep * both)
        share = peak * wear_turn * dwell[k] / uz
        weight = weighed = 0.0
        for j in range(max(0, int((py[k] - a - y0) / cell) + 1), min(ny - 1, int((py[k] + a - y0) / cell)) + 1):
            qy = y0 + j * cell - py[k]
            for i in range(max(0, int((px[k] - a - x0) / cell) + 1), min(nx - 1, int((px[k] + a - x0) / cell)) + 1):
                qx = x0 + i * cell - px[k]
                qz = z[j, i] - pz[k]
                along = qx * ux + qy * uy + qz * uz
                inside = 1.0 - (qx * qx + qy * qy + qz * qz - along * along) / a2
                if inside > 0.0:
                    sliding = math.hypot(px[k] + qx - cx, py[k] + qy - cy)
                    here = share * math.sqrt(inside) * sliding
                    off[j, i] += here
                    weight += here
                    weighed += here * values[j, i]
        if weight > 0.0:
            seen[k] = weighed / weight
