"""Which points of a path are written: by slope error on the optical surface, by sag where stock is left.

Light sees slopes. Vertices s apart on curvature k make a chord that is off by k s / 2 in slope and k s^2 / 8 in height;
at 0.5 mrad that is some nanometres, a thousand times finer than a usual tolerance. Both are bounded here, from the
exact slope and curvature that the contact gives at every probe. Where the ball touches the run-out there is no light,
and a larger sag is enough: the run-out bends far more than the lens, and under the lens's rule a tenth of all vertices
would lie there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cam.moves import Array
from cam.surface.contact import touch

TICKS_PER_MM = 10_000
"""x and y are written with four decimals, so contact is solved on that raster and only z is ever rounded."""


BESIDE_MM = 0.1
"""Within this distance of the aperture the run-out is followed like the lens; beyond it, a ball of R = 5 mm clears the
rim by 1 µm.
"""

RUN_OUT_SAG_MM = 0.5e-3
_SAG_MM_PER_RAD = 0.024
SLOPE_ERROR_RAD = 0.5e-3


class VertexRule(NamedTuple):
    """Bounds of one chord: slope error, sag, length; and the greatest distance between probes of the surface.

    min_mm wins over slope and sag: a shorter chord would only show the last decimal of z.
    optical_from_mm, optical_to_mm : where slope_rad and sag_mm rule, in x of the contact; beyond, run_out_sag_mm alone
    """

    slope_rad: float
    sag_mm: float
    run_out_sag_mm: float
    optical_from_mm: float
    optical_to_mm: float
    min_mm: float
    max_mm: float
    probe_mm: float


def finish_rule(
    slope_error_rad: float, probe_mm: float, *, aperture_x_mm: tuple[float, float] = (-math.inf, math.inf)
) -> VertexRule:
    """Return the rule of the optical surface. At 0.5 mrad the sag is 12 nm, 9 nm rms over a chord; it rules where it is
    flat.
    """
    return VertexRule(
        slope_rad=slope_error_rad,
        sag_mm=_SAG_MM_PER_RAD * slope_error_rad,
        run_out_sag_mm=RUN_OUT_SAG_MM,
        optical_from_mm=aperture_x_mm[0] - BESIDE_MM,
        optical_to_mm=aperture_x_mm[1] + BESIDE_MM,
        min_mm=0.01,
        max_mm=1.0,
        probe_mm=probe_mm,
    )


def rough_sag_mm(leave_mm: float) -> float:
    """Return the rule for a pass that leaves stock: only the height counts, 5 % of the stock left."""
    return 0.05 * leave_mm


def rough_rule(leave_mm: float, probe_mm: float) -> VertexRule:
    sag_mm = rough_sag_mm(leave_mm)
    return VertexRule(
        slope_rad=math.inf,
        sag_mm=sag_mm,
        run_out_sag_mm=sag_mm,
        optical_from_mm=-math.inf,
        optical_to_mm=math.inf,
        min_mm=0.01,
        max_mm=2.0,
        probe_mm=probe_mm,
    )


def most_vertices(length_mm: float, rule: VertexRule) -> int:
    """Return the greatest number of vertices of one row."""
    return math.ceil(length_mm / rule.min_mm) + 2


@njit(cache=True, nogil=True)
def _bounds(rule, px):  # type: ignore[no-untyped-def]
    """Return the (slope error, sag) that a chord touching at px may have."""
    if rule.optical_from_mm <= px <= rule.optical_to_mm:
        return rule.slope_rad, rule.sag_mm
    return math.inf, rule.run_out_sag_mm


@njit(cache=True, nogil=True)
def _next_step(rule, slope, sag, curvature, used):  # type: ignore[no-untyped-def]
    """Return ticks to the next probe: 0.9 of what the bounds allow a chord here, less what it already used."""
    k = abs(curvature) + 1e-9
    allowed = 0.9 * min(2.0 * slope / k, math.sqrt(8.0 * sag / k), rule.max_mm / 0.9)
    step = allowed - used if used < 0.75 * allowed else allowed
    return int(max(min(step, rule.probe_mm), rule.min_mm) * 10_000)


@njit(cache=True, nogil=True)
def march_row(b, rule, y, x_from, x_to, out, count):  # type: ignore[no-untyped-def]
    """Write vertices of the row at y from x_from to x_to, both included, into out[count:] (n, 3); return the new count.

    From an anchor (the last vertex) probes go ahead; the farthest one whose chord keeps the rule becomes the next
    vertex. A chord's slope error is judged by the extremes of the exact slope at its probes, and between two probes
    of opposite curvature by the extreme of the quadratic through them. Its sag is at most k s^2 / 8 on a smooth path;
    where the ball changes flanks the slope jumps by d without curvature and the sag is at most d s / 4.
    """
    ticks = int(math.floor(x_from * 10_000 + 0.5))
    last = int(math.floor(x_to * 10_000 + 0.5))
    way = 1 if last > ticks else -1
    x = ticks / 10_000
    px, py, z, s, k, dpx, dpy = touch(b, x, y, x, y)
    ax, az = x, z  # anchor
    low, high, bend = s, s, abs(k)
    slope, sag = _bounds(rule, px)  # the tightest bounds of all places that this chord touches
    has_candidate = False
    out[count, 0], out[count, 1], out[count, 2] = x, y, z
    count += 1
    halvings = 0
    while ticks != last:
        used = abs(x - ax)
        step = max(_next_step(rule, slope, sag, k, used) >> halvings, int(rule.min_mm * 10_000))
        left = abs(last - ticks)
        if step >= left:
            step = left
        n_ticks = ticks + way * step
        nx = n_ticks / 10_000
        qx, qy, nz, ns, nk, ndpx, ndpy = touch(b, nx, y, px + dpx * (nx - x), py + dpy * (nx - x))
        while True:
            n_low, n_high = min(low, ns), max(high, ns)
            if k * nk < 0.0:
                extreme = s + 0.5 * k * (nx - x) * k / (k - nk)
                n_low, n_high = min(n_low, extreme), max(n_high, extreme)
            n_bend = max(bend, abs(nk))
            length = abs(nx - ax)
            chord = (nz - az) / (nx - ax)
            n_slope, n_sag = _bounds(rule, qx)
            n_slope, n_sag = min(slope, n_slope), min(sag, n_sag)
            good = (
                max(n_high - chord, chord - n_low) <= n_slope
                and max(n_bend * length, n_high - n_low) * length <= 8.0 * n_sag
                and length <= rule.max_mm + 1e-9
            )
            if good or not has_candidate:
                break
            out[count, 0], out[count, 1], out[count, 2] = x, y, z  # the candidate becomes vertex and anchor
            count += 1
            ax, az, low, high, bend = x, z, s, s, abs(k)
            slope, sag = _bounds(rule, px)
            has_candidate = False
        if not good and step > int(rule.min_mm * 10_000):
            halvings += 1
            continue
        halvings = 0
        ticks, x, z, s, k = n_ticks, nx, nz, ns, nk
        px, py, dpx, dpy = qx, qy, ndpx, ndpy
        if good:
            low, high, bend, slope, sag, has_candidate = n_low, n_high, n_bend, n_slope, n_sag, True
        else:  # the shortest chord allowed
            out[count, 0], out[count, 1], out[count, 2] = x, y, z
            count += 1
            ax, az, low, high, bend = x, z, s, s, abs(k)
            slope, sag = _bounds(rule, px)
    if has_candidate:
        out[count, 0], out[count, 1], out[count, 2] = x, y, z
        count += 1
    return count


@njit(cache=True, nogil=True)
def _thin(x, z, tolerance):  # type: ignore[no-untyped-def]
    """Return the indices kept: from each the farthest point whose chord passes all between within the tolerance."""
    keep = np.empty(x.size, np.int64)
    keep[0] = 0
    count, anchor, i = 1, 0, 1
    low, high = -np.inf, np.inf
    while i < x.size:
        run = abs(x[i] - x[anchor])
        slope = (z[i] - z[anchor]) / run
        if slope < low or slope > high:
            anchor = i - 1
            keep[count] = anchor
            count += 1
            low, high = -np.inf, np.inf
            continue
        low = max(low, slope - tolerance / run)
        high = min(high, slope + tolerance / run)
        i += 1
    if keep[count - 1] != x.size - 1:
        keep[count] = x.size - 1
        count += 1
    return keep[:count]


def thin_points(points_mm: Array, tolerance_mm: float, *, along: int = 0) -> Array:
    """Return the fewest of the points (n, 3) of a line parallel to an axis, in order along it, within the tolerance in
    Z.

    along : 0 for a line along X, 1 for one along Y
    """
    if len(points_mm) < 3:
        return points_mm
    run, z = (np.ascontiguousarray(points_mm[:, column]) for column in (along, 2))
    keep = _thin(run, z, max(tolerance_mm, 1e-9))
    return points_mm[keep]


@njit(cache=True, nogil=True)
def _thin_pieces(x, z, edges, tolerance, keep, kept):  # type: ignore[no-untyped-def]
    """Write the indices of the points kept of all pieces edges[n]..edges[n + 1] - 1, and where each piece begins among
    them.
    """
    count = 0
    for n in range(edges.size - 1):
        kept[n] = count
        for k in _thin(x[edges[n] : edges[n + 1]], z[edges[n] : edges[n + 1]], tolerance):
            keep[count] = edges[n] + k
            count += 1
    kept[-1] = count


def thin_pieces(points_mm: Array, edges: NDArray[np.int64], tolerance_mm: float) -> list[Array]:
    """Return pieces along X of points (n, 3), which begin and end at edges (m + 1,), each thinned by itself."""
    keep, kept = np.empty(len(points_mm), np.int64), np.empty_like(edges)
    x, z = (np.ascontiguousarray(points_mm[:, column]) for column in (0, 2))
    _thin_pieces(x, z, edges, max(tolerance_mm, 1e-9), keep, kept)
    return np.split(points_mm[keep[: kept[-1]]], kept[1:-1])
