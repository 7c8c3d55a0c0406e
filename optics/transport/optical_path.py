"""The optical path to the screen as the unknown: near-field Snell refraction in closed form, without integration.

c(q) is the optical length from the light, through the refracting surface, to the point q of the screen at z = H. All
light through one surface point p = (x, y) at height t obeys phase(p, t) + |q - (p, t)| = c(q), and c is stationary in
p, so grad c = s is the direction of the light that arrives at q. Hence, exactly: X = (q, H) - R (s, s_z) is the surface
point, with s_z = sqrt(1 - |s|^2) and R from phase(X) + R = c. For upright light, phase = n t:

    R = (n H - c) / (n s_z - 1),   p(q) = q - R s,   t = H - R s_z

If c is constant under upright light, the surface is flat: c = H + (n - 1) t. c is the sum of the base, which spreads
the aperture over a screen of another size, and a remainder that has almost no slope across the frame, so that it can be
mirrored there and expanded in cosines. Mirrors are the same with n = 1 and light that comes down.
"""

from __future__ import annotations

import math

import numpy as np

from optics.bench import Bench
from optics.errors import NoSurfaceError
from optics.light import Beam, meet
from optics.outline import dim_outside, lower_outside, rim_curves
from optics.spline import Array, BicubicSpline
from optics.threads import run_on_rows
from optics.transport.beam_path import fill_corner_points, fill_face_areas, fill_heights, trace_back
from optics.transport.even_light import fill_corner_preimages, fill_preimage_areas, rim_slopes
from optics.transport.rims import Rims, corner_rays, solve_rims


class Preimages:
    """Measures the pre-images of a grid of pixels for each iterate of the optical path.

    across, along, mixed (ny, nx) : area of a pixel's pre-image on the face = across * along - mixed, where the mean
                    pixel's is about 1; across and along are positive where the map goes the branch's way
    light         : strength of the light on each pre-image, scaled so that light * area has mean 1; (1, 1) if even
    sign          : 1 if an increase of Laplace(c) reduces the area, -1 on the inverted branch
    reach_mm      : (x, y) how far the pre-image moves for a change of slope, near the screen's centre
    path_per_height : change of c when the whole surface rises by 1
    """

    def __init__(self, bench: Bench, shape: tuple[int, ...]) -> None:
        ny, nx = shape
        self.bench, self.sign = bench, bench.sign
        self.across, self.along, self.mixed = (np.empty((ny, nx)) for _ in range(3))
        self.even = bench.even_upright_light
        self.light = np.ones((1, 1)) if self.even else np.empty((ny, nx))
        self._top = np.empty(ny)
        self._beam = bench.beam()
        self.reach_mm, self.path_per_height = _about_the_centre(bench, self._beam)
        self._arguments = bench.kernel_arguments(nx, ny)
        if not self.even:
            self._beam = dim_outside(self._beam, bench, pixels=max(ny, nx))
            self._curves = rim_curves(bench)
            throw, _, left, bottom, dx, dy, *_ = self._arguments
            self._frame = (throw, left, bottom, dx, dy)
            self._units = _pixels_per_mm(bench, self._beam, nx, ny)

    def evaluate(self, c: Array) -> float:
        """Measure the pre-images for c; return the greatest height found (NaN: no light could go that way)."""
        if self.even:
            rim_x, rim_y = rim_slopes(c, self.bench)
            run_on_rows(
                fill_preimage_areas, c.shape[0],
                c, rim_x, rim_y, *self._arguments, self.across, self.along, self.mixed, self._top,
            )  # fmt: skip
            return self._greatest_height(c)
        ghosts, rims = self._add_border(c)
        run_on_rows(
            fill_face_areas, c.shape[0],
            ghosts, rims.points_x, rims.points_y, self._beam, *self._frame, *self._units,
            self.across, self.along, self.mixed, self.light, self._top,
        )  # fmt: skip
        area = self.across * self.along - self.mixed
        self.light *= 1.0 / float(np.mean(area * self.light))
        if self.bench.outline_mm is not None:
            return max(
                float(self._top.max()), rims.greatest_height_around(self.bench, self.bench.width_mm / c.shape[1])
            )
        return self._greatest_height(c)

    def corners(self, c: Array) -> tuple[Array, Array]:
        """Return lens points px, py (ny + 1, nx + 1) that light the pixels' corners; those of the frame lie on the
        rim.
        """
        ny, nx = c.shape
        px, py = np.empty((ny + 1, nx + 1)), np.empty((ny + 1, nx + 1))
        if self.even:
            run_on_rows(fill_corner_preimages, ny + 1, c, *rim_slopes(c, self.bench), *self._arguments, px, py)
            return px, py
        ghosts, rims = self._add_border(c)
        run_on_rows(fill_corner_points, ny + 1, ghosts, self._beam, *self._frame, px, py)
        for points, of in ((px, 3), (py, 4)):
            for side in (0, -1):
                points[:, side] = _between(rims.points_x[side, :, of])
                points[side, 1:-1] = _between(rims.points_y[side, :, of])[1:-1]
        if self.bench.outline_mm is not None:
            for points, of in ((px, 3), (py, 4)):
                for j in (0, -1):
                    for i in (0, -1):
                        points[j, i] = 0.5 * (rims.points_x[i, j, of] + rims.points_y[j, i, of])
        else:
            far = (self.bench.width_mm, self.bench.height_mm)
            for points, axis in ((px, 0), (py, 1)):
                for j in (0, -1):
                    for i in (0, -1):
                        low = ((i, j)[axis] == 0) == (self.sign > 0)
                        points[j, i] = 0.0 if low else far[axis]
        return px, py

    def _greatest_height(self, c: Array) -> float:
        """Return the greatest height at the rows and corners, where a prism or a diverging lens is highest."""
        return float(max(self._top.max(), corner_rays(c, self.bench, self._beam)[2].max()))

    def _add_border(self, c: Array) -> tuple[Array, Rims]:
        rims = solve_rims(c, self.bench, self._beam, self._curves)
        return rims.add_border(c, *self._frame[3:]), rims


def _between(middles: Array) -> Array:
    """Return values at the ends of edges from those at their middles."""
    ends = np.empty(middles.size + 1)
    ends[1:-1] = 0.5 * (middles[1:] + middles[:-1])
    ends[0], ends[-1] = 1.5 * middles[0] - 0.5 * middles[1], 1.5 * middles[-1] - 0.5 * middles[-2]
    return ends


def _central_ray(bench: Bench, height_mm: float = 0.0) -> tuple[float, float, float]:
    """Return (c, s_x, s_y) of the ray from the aperture's middle at that height to the screen's."""
    ax, ay = bench.shift_mm
    ray = math.sqrt(ax**2 + ay**2 + (bench.throw_mm - height_mm) ** 2)
    phase = meet(bench.beam(), bench.width_mm / 2, bench.height_mm / 2, height_mm)[3]
    return phase + ray, ax / ray, ay / ray


def _about_the_centre(bench: Bench, beam: Beam) -> tuple[tuple[float, float], float]:
    """Return ((reach_x, reach_y), path per height) as in Preimages, by small changes of the central ray."""
    c, sx, sy = _central_ray(bench)
    s, step = bench.screen, 1e-4

    def face(along_x: float, along_y: float) -> tuple[float, ...]:
        back = trace_back(
            beam, s.centre_x_mm, s.centre_y_mm, bench.throw_mm, c, sx + along_x, sy + along_y, bench.throw_mm
        )
        return back[4:]

    reach_x = (face(-step, 0.0)[0] - face(step, 0.0)[0]) / (2 * step)
    reach_y = (face(0.0, -step)[1] - face(0.0, step)[1]) / (2 * step)
    return (reach_x, reach_y), (_central_ray(bench, step)[0] - _central_ray(bench, -step)[0]) / (2 * step)


def _pixels_per_mm(bench: Bench, beam: Beam, nx: int, ny: int) -> tuple[float, float]:
    """Return units in which the mean pixel's share of the face is about 1, signed so that the branch's direction is
    positive.
    """
    width, height = bench.width_mm, bench.height_mm
    wide = meet(beam, width, height / 2, 0.0)[4] - meet(beam, 0.0, height / 2, 0.0)[4]
    high = meet(beam, width / 2, height, 0.0)[5] - meet(beam, width / 2, 0.0, 0.0)[5]
    return bench.sign * nx / wide, bench.sign * ny / high


def flat_path_mm(bench: Bench, shape: tuple[int, ...], *, skim_mm: float) -> Array:
    """Return the optical path (ny, nx) to start from: a surface with hardly more curvature than necessary, and the
    base.
    """
    qx, qy = bench.pixel_centres_mm(shape[1], shape[0])
    return _central_ray(bench, -skim_mm)[0] + bench.base_path_mm(qx[None, :], qy[:, None])


def _path_spline(c: Array, bench: Bench) -> BicubicSpline:
    """Return delta = c - base through the pixel centres and three ghosts, which continue it by its slope on the
    frame.
    """
    ny, nx = c.shape
    s, pad = bench.screen, 3
    dx, dy = s.width_mm / nx, s.height_mm / ny
    if bench.even_upright_light:
        rim_x, rim_y = rim_slopes(c, bench)
    else:
        rims = solve_rims(c, bench, bench.beam(), rim_curves(bench))
        rim_x, rim_y = rims.slope_x, rims.slope_y
    qx, qy = bench.pixel_centres_mm(nx, ny)
    ghosts = np.pad(c - bench.base_path_mm(qx[None, :], qy[:, None]), pad, mode="symmetric")
    ways = 2.0 * np.arange(pad) + 1.0  # from a ghost to its mirror image, in pixels
    for side, sign in ((0, -1.0), (1, 1.0)):
        edge_x, edge_y = s.left_mm + side * s.width_mm, s.bottom_mm + side * s.height_mm
        base_x = (bench.base_path_mm(edge_x + dx / 2, qy) - bench.base_path_mm(edge_x - dx / 2, qy)) / dx
        base_y = (bench.base_path_mm(qx, edge_y + dy / 2) - bench.base_path_mm(qx, edge_y - dy / 2)) / dy
        left_right = sign * np.pad(rim_x[side] - base_x, pad, mode="edge") * dx
        bottom_top = sign * np.pad(rim_y[side] - base_y, pad, mode="edge") * dy
        at = slice(None, pad) if side == 0 else slice(-pad, None)
        order = ways[::-1] if side == 0 else ways
        ghosts[:, at] += left_right[:, None] * order[None, :]
        ghosts[at, :] += order[:, None] * bottom_top[None, :]
    return BicubicSpline.through(
        ghosts, x0_mm=s.left_mm + (0.5 - pad) * dx, y0_mm=s.bottom_mm + (0.5 - pad) * dy, dx_mm=dx, dy_mm=dy
    )


def heights_mm(c: Array, u: Array, v: Array, x_mm: Array, y_mm: Array, bench: Bench) -> Array:
    """Return heights t of the surface at the lens points (x_mm[i], y_mm[j]) that light the screen at grid indices u, v.

    c (ny, nx) at the pixel centres; u, v (my, mx) fractional indices of pixel corners.
    t is stationary in q, so the error of q enters squared.
    raises NoSurfaceError if there is a lens point that has no height
    """
    ny, nx = c.shape
    s, beam = bench.screen, bench.beam()
    dx, dy = s.width_mm / nx, s.height_mm / ny
    spline = _path_spline(c, bench)
    t = np.empty_like(u)
    for rows in np.array_split(np.arange(u.shape[0]), max(1, u.shape[0] // 128)):  # bounds the temporaries
        qx, qy = s.left_mm + u[rows] * dx, s.bottom_mm + v[rows] * dy
        path = spline.heights_mm(qx, qy) + bench.base_path_mm(qx, qy)
        part = np.empty_like(path)
        run_on_rows(fill_heights, rows.size, path, qx, qy, x_mm, y_mm[rows], bench.throw_mm, beam, part)
        t[rows] = part
    if not np.isfinite(t).all():
        raise NoSurfaceError(lost_share=float(np.mean(~np.isfinite(t))))
    return lower_outside(t, bench, x_mm, y_mm, margin_mm=bench.width_mm / nx)
