"""The paper's surface (section 3.2): heights from the mapping, by Poisson's equation on the moved mesh (Eqs. 5-9).

The gradient that sends the light of p to q depends on the height (Eqs. 8-9), so heights and gradients are computed
alternately until the heights converge. The weak form is  int grad(h) . grad(v) = int N . grad(v):  its natural boundary
is dh/dn = N . n. Where N has curl, no surface has that gradient; this one is nearest to it in the mean square. The
mapping is read through the C2 splines of the moved grid's displacement, inverted by Newton.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline

from optics.bench import Bench
from optics.errors import TotalReflectionError, UnsupportedBenchError
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.paper.flow import FlowSettings, PaperFlow, solve_paper_map
from optics.paper.flow_darts import on_lattice
from optics.paper.mesh import TriangleMesh
from optics.paper.poisson import NeumannPoisson, divergence_load
from optics.refraction import slope_for_shift
from optics.spline import Array
from optics.transport_map import screen_positions
from phrases.phrase import Phrase

Progress = Callable[[str, float], None]

_MOST_SWEEPS = 30
_STILL_MM = 1e-6
_NEWTON_STEPS = 2


class SmoothGridMap:
    """The C2 map q -> p through the vertices of a moved grid: bicubic splines of the displacement, inverted by Newton.

    x_mm (mx,), y_mm (my,) : the grid's own coordinates, ascending, spacing free
    moved_mm (my, mx, 2)   : where its vertices lie now; both triangles of every cell are still counter-clockwise
    """

    def __init__(self, x_mm: Array, y_mm: Array, moved_mm: Array) -> None:
        self._x_mm, self._y_mm, self._moved_mm = x_mm, y_mm, moved_mm
        self._shift_x = spline_over(x_mm, y_mm, moved_mm[..., 0] - x_mm[None, :])
        self._shift_y = spline_over(x_mm, y_mm, moved_mm[..., 1] - y_mm[:, None])

    def preimages_mm(self, at_x_mm: Array, at_y_mm: Array) -> Array:
        """Return (ny, nx, 2) grid coordinates q of the vertices (at_x_mm[i], at_y_mm[j]) of a regular grid.

        Starts from the bilinear inverse in the quad that holds the point. A Newton step, with the Jacobian of the
        start, counts only where it brings the point nearer and stays within a cell; elsewhere (beside a crease, where
        the smooth map may fold) the last answer is kept.
        """
        u, v = screen_positions(self._moved_mm[..., 0], self._moved_mm[..., 1], at_x_mm, at_y_mm)
        columns, rows = np.arange(self._x_mm.size), np.arange(self._y_mm.size)
        q = np.stack([np.interp(u, columns, self._x_mm), np.interp(v, rows, self._y_mm)], axis=-1).reshape(-1, 2)
        wanted = np.stack(np.meshgrid(at_x_mm, at_y_mm), axis=-1).reshape(-1, 2)
        low, high = np.array([self._x_mm[0], self._y_mm[0]]), np.array([self._x_mm[-1], self._y_mm[-1]])
        reach = max(np.diff(self._x_mm).max(), np.diff(self._y_mm).max())
        miss = wanted - self.images_mm(q)
        inverse = self._inverse_jacobians(q)
        for _ in range(_NEWTON_STEPS):
            step = np.einsum("nij,nj->ni", inverse, miss)
            step *= (np.abs(step).max(axis=1) <= reach)[:, None]
            trial = np.clip(q + step, low, high)
            trial_miss = wanted - self.images_mm(trial)
            nearer = (trial_miss**2).sum(axis=1) < (miss**2).sum(axis=1)
            q[nearer], miss[nearer] = trial[nearer], trial_miss[nearer]
        return q.reshape(at_y_mm.size, at_x_mm.size, 2)

    def images_mm(self, q: Array) -> Array:
        """Return (n, 2) points p of the grid coordinates q (n, 2)."""
        return q + np.stack([self._shift_x.ev(q[:, 1], q[:, 0]), self._shift_y.ev(q[:, 1], q[:, 0])], axis=1)

    def _inverse_jacobians(self, q: Array) -> Array:
        """Return (n, 2, 2) inverse of dp/dq; zero where the smooth map turns over."""
        y, x = q[:, 1], q[:, 0]
        xx, xy = 1.0 + self._shift_x.ev(y, x, dy=1), self._shift_x.ev(y, x, dx=1)
        yx, yy = self._shift_y.ev(y, x, dy=1), 1.0 + self._shift_y.ev(y, x, dx=1)
        determinant = xx * yy - xy * yx
        inverse = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=determinant > 0.0)
        return np.stack([yy, -xy, -yx, xx], axis=1).reshape(-1, 2, 2) * inverse[:, None, None]


def spline_over(x_mm: Array, y_mm: Array, values: Array) -> RectBivariateSpline:
    """Return the interpolating bicubic spline of values (ny, nx); call .ev(y, x): the first argument runs along the
    rows.
    """
    return RectBivariateSpline(y_mm, x_mm, values, kx=3, ky=3, s=0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperSurface:
    """Heights on the moved vertices of the flow's mesh, highest at -skim_mm: h_mm (n,)."""

    h_mm: Array
    converged: bool
    changes_mm: tuple[float, ...]  # largest change of a height in each sweep
    misfit_rms: float  # rms over the lens of |grad h - N|: what the curl of N leaves


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperLens:
    """The lens of the paper's method with the record of its two stages."""

    heightfield: Heightfield
    flow: PaperFlow
    surface: PaperSurface
    screen_mm: Array  # (ny + 1, nx + 1, 2) corners of the screen's pixels
    lens_mm: Array  # (ny + 1, nx + 1, 2) where on the lens their light comes from

    @property
    def converged(self) -> bool:
        return self.flow.converged and self.surface.converged

    @property
    def message(self) -> Phrase:
        sweeps = len(self.surface.changes_mm)
        if self.surface.converged:
            return Phrase("{flow} The surface took {count} sweeps.", flow=self.flow.message, count=sweeps)
        return Phrase(
            "{flow} The surface still moved {moved_mm:.1e} mm after {count} sweeps.",
            flow=self.flow.message,
            moved_mm=self.surface.changes_mm[-1],
            count=sweeps,
        )

    def history(self) -> list[dict[str, Any]]:
        """Return JSON-able dicts: one per flow step, then one for the surface."""
        surface = {
            "stage": "surface",
            "sweeps": len(self.surface.changes_mm),
            "changes_mm": list(self.surface.changes_mm),
            "slope_misfit_rms": self.surface.misfit_rms,
        }
        return [{"stage": "flow", **step} for step in self.flow.history()] + [surface]


def paper_lens(
    target: Array,
    settings: LensSettings,
    *,
    flow_settings: FlowSettings | None = None,
    on_progress: Progress | None = None,
) -> PaperLens:
    """Return the lens for target (ny, nx), work frame, by the paper's method.

    Even light straight through a whole rectangular block, as in the paper. A screen of another size or place starts the
    flow at the screen point x W_screen / W + shift: the flow runs in lens coordinates all the same. Unless
    `flow_settings` says otherwise, a mesh that gets stuck is remeshed "clean".
    errors : UnsupportedBenchError, TargetError (see solve_paper_map);
             TotalReflectionError if some light would not leave the surface
    """
    bench = settings.bench
    _refuse_what_the_paper_has_not(bench)
    ny, nx = target.shape
    vertices_x, vertices_y = settings.vertices(nx), settings.vertices(ny)
    flow = solve_paper_map(
        target,
        width_mm=bench.width_mm,
        height_mm=bench.height_mm,
        settings=flow_settings or FlowSettings(remeshing="clean"),
        lens_cells=(vertices_x - 1, vertices_y - 1),
        on_progress=on_progress,
    )
    scale = np.array([bench.screen.width_mm / bench.width_mm, bench.screen.height_mm / bench.height_mm])
    corner = np.array([bench.screen.left_mm, bench.screen.bottom_mm])
    surface = solve_paper_surface(
        corner + flow.pair.screen.points_mm * scale,
        flow.pair.lens,
        throw_mm=bench.throw_mm,
        refractive_index=bench.refractive_index,
        skim_mm=settings.skim_mm,
    )
    if on_progress is not None:
        on_progress("surface", 0.5)
    heightfield = _heightfield(flow, surface.h_mm, vertices_x, vertices_y, settings.skim_mm)
    if on_progress is not None:
        on_progress("surface", 1.0)
    corners, lens = flow.corners_mm()
    return PaperLens(
        heightfield=heightfield, flow=flow, surface=surface, screen_mm=corner + corners * scale, lens_mm=lens
    )


def solve_paper_surface(
    screen_mm: Array, mesh: TriangleMesh, *, throw_mm: float, refractive_index: float, skim_mm: float
) -> PaperSurface:
    """Return heights on the vertices of the lens's mesh that send their light to screen_mm (n, 2), throw_mm above
    Z0.
    """
    points = mesh.points_mm
    shift = screen_mm - points
    _refuse_total_reflection(shift, throw_mm, skim_mm, refractive_index)
    problem = NeumannPoisson(mesh).factor(mesh)

    h = np.full(points.shape[0], -skim_mm)
    changes: list[float] = []
    while len(changes) < _MOST_SWEEPS and (not changes or changes[-1] > _STILL_MM):
        normal = slope_for_shift(shift, throw_mm - h, refractive_index=refractive_index)
        values = problem.solve(divergence_load(mesh, normal), guess=h - h.mean(), tolerance=1e-9).values
        values -= values.max() + skim_mm
        changes.append(float(np.abs(values - h).max()))
        h = values
    normal = slope_for_shift(shift, throw_mm - h, refractive_index=refractive_index)
    return PaperSurface(
        h_mm=h,
        converged=changes[-1] <= _STILL_MM,
        changes_mm=tuple(changes),
        misfit_rms=_slope_misfit(mesh, h, normal),
    )


def _heightfield(flow: PaperFlow, h_mm: Array, vertices_x: int, vertices_y: int, skim_mm: float) -> Heightfield:
    """Return the lens's grid of heights. After clean remeshing the mesh is that grid already."""
    if flow.remeshing == "clean":
        z_mm = h_mm.reshape(vertices_y, vertices_x)
        return Heightfield.on_aperture(z_mm, width_mm=float(flow.x_mm[-1]), height_mm=float(flow.y_mm[-1]))
    if flow.remeshing == "simple":
        h_mm = on_lattice(flow.pair, h_mm[:, None], flow.x_mm, flow.y_mm)[..., 0]
    lattice = h_mm.reshape(flow.target.shape)
    return resample_heights(flow, lattice, vertices_x=vertices_x, vertices_y=vertices_y, skim_mm=skim_mm)


def resample_heights(flow: PaperFlow, h_mm: Array, *, vertices_x: int, vertices_y: int, skim_mm: float) -> Heightfield:
    """Return heights from the moved mesh on the lens's regular grid: h(q) as a spline over the screen, read at q(p).

    If it were read in the flat triangles instead, the lens would have facets a pixel wide, which would be visible in
    the picture.
    """
    x_mm = np.linspace(flow.x_mm[0], flow.x_mm[-1], vertices_x)
    y_mm = np.linspace(flow.y_mm[0], flow.y_mm[-1], vertices_y)
    q = SmoothGridMap(flow.x_mm, flow.y_mm, flow.lens_mm).preimages_mm(x_mm, y_mm)
    z = spline_over(flow.x_mm, flow.y_mm, h_mm).ev(q[..., 1], q[..., 0])
    return Heightfield(x_mm=x_mm, y_mm=y_mm, z_mm=z - z.max() - skim_mm)


def _slope_misfit(mesh: TriangleMesh, h: Array, normal: Array) -> float:
    areas = mesh.areas()
    gradients = mesh.triangle_gradients(h)
    wanted = normal[mesh.triangles].mean(axis=1)
    return float(np.sqrt(np.dot(areas, ((gradients - wanted) ** 2).sum(axis=1)) / areas.sum()))


def _refuse_what_the_paper_has_not(bench: Bench) -> None:
    light = bench.light
    others = {
        Phrase("a lamp at a finite distance"): light.is_point,
        Phrase("light of uneven strength"): light.profile is not None,
        Phrase("tilted light"): light.tilt_rad != (0.0, 0.0),
        Phrase("a mirror"): bench.mirror,
        Phrase("an outline"): bench.outline_mm is not None,
        Phrase("the inverted branch"): bench.branch == "inverted",
    }
    unknown = [name for name, wanted in others.items() if wanted]
    if unknown:
        raise UnsupportedBenchError(Phrase("the paper's method"), unknown)


def _refuse_total_reflection(shift_mm: Array, throw_mm: float, skim_mm: float, refractive_index: float) -> None:
    """Raise TotalReflectionError if the light turns by more than arccos(1 / n), at the shortest drop."""
    farthest_mm = float(np.sqrt((shift_mm**2).sum(axis=1)).max())
    shortest_mm = farthest_mm / np.sqrt(refractive_index**2 - 1.0)
    if throw_mm + skim_mm <= shortest_mm:
        raise TotalReflectionError(throw_mm=throw_mm, shift_mm=farthest_mm, shortest_throw_mm=1.2 * shortest_mm)
