"""The paper's flow with clean remeshing: a mesh that gets stuck is put back on an even grid over the lens.

The paper's section 5 leaves this open ("a mesh smoothing technique to keep the mesh clean"). Triangles flip because
those between bright and dark become thin *on the lens*. So the mesh is not repaired but replaced: the new vertices are
those of an even grid over the lens, and each takes the screen point that the map gives it. The map is the same, all
triangles on the lens are as good as at the start, and earlier steps do not limit the next one. Thin or large triangles
are now on the screen, where the step rule does not depend on them: the dark parts of the picture have few vertices and
the bright ones many, because vertices go where the light is. No vertex is random, so lines and edges stay straight.

- D of a face of any shape on the screen is exact (face_light); the Poisson source is its light, as before.
- Steps start on every second of the lens's own vertices; the last grid *is* the lens's, so the surface is solved on it
  and nothing is resampled on the way to the heightfield.
- Bilinear interpolation keeps the map one-to-one except in a few triangles beside creases: their screen points are
  averaged with their neighbours' until none is turned over. It also blurs a little; the steps after it undo that. The
  best state on the even grid is the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates

from optics.paper.flow_rules import (
    KEPT_STEPS,
    FlowSettings,
    FlowSnapshot,
    FlowStep,
    PaperFlow,
    Progress,
    excess_on_faces,
    floor_notes,
    pixel_vertices,
    project_to_frame,
    raise_to_floor,
    rms_over,
)
from optics.paper.mesh import MeshPair, TriangleMesh, Triangles
from optics.paper.mesh_surgery import Neighbours, neighbours_of
from optics.paper.poisson import NeumannPoisson
from optics.spline import Array
from optics.transport_map import screen_positions
from phrases.phrase import Phrase, join

_COARSER = (2, 1)
_LEAST_CELLS = 24  # of the smaller side of a coarse grid
_SHORT_STEP = 0.25  # remesh after a step below this ...
_MOST_BETWEEN = 3  # ... and after this many steps in any case
_STALLED_STEPS = 6  # a grid is finished when this many steps did not lower the rms ...
_GAIN = 0.05  # ... by this share;
_COARSE_GAIN = 0.2  # a coarse grid is left earlier
_LEAST_ON_SCREEN = 1e-4  # of the mean triangle
_UNTURNING_ROUNDS = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Even:
    """An even grid over the lens and the screen points (my, mx, 2) of its vertices."""

    x_mm: Array
    y_mm: Array
    screen_mm: Array

    @classmethod
    def identity(cls, size_mm: tuple[float, float], cells: tuple[int, int]) -> _Even:
        x_mm, y_mm = np.linspace(0.0, size_mm[0], cells[0] + 1), np.linspace(0.0, size_mm[1], cells[1] + 1)
        return cls(x_mm=x_mm, y_mm=y_mm, screen_mm=np.stack(np.meshgrid(x_mm, y_mm), axis=-1))

    def pair(self) -> MeshPair:
        lens = TriangleMesh.build_regular(self.x_mm, self.y_mm)
        return MeshPair(screen=lens.move_to(self.screen_mm.reshape(-1, 2)), lens=lens)

    def regrid(self, moved_mm: Array) -> _Even:
        """Return the even grid again after its vertices have moved to moved_mm (my, mx, 2) on the lens."""
        at = screen_positions(moved_mm[..., 0], moved_mm[..., 1], self.x_mm, self.y_mm)
        return self._carry_over(_read(self.screen_mm, *at))

    def refine(self, cells: tuple[int, int]) -> _Even:
        """Return the same map on another even grid."""
        grown = self.identity((float(self.x_mm[-1]), float(self.y_mm[-1])), cells)
        u = np.linspace(0.0, self.x_mm.size - 1.0, grown.x_mm.size)
        v = np.linspace(0.0, self.y_mm.size - 1.0, grown.y_mm.size)
        return grown._carry_over(_read(self.screen_mm, *np.meshgrid(u, v), order=3))

    def _carry_over(self, screen_mm: Array) -> _Even:
        screen_mm[:, 0, 0], screen_mm[:, -1, 0] = 0.0, self.x_mm[-1]
        screen_mm[0, :, 1], screen_mm[-1, :, 1] = 0.0, self.y_mm[-1]
        triangles = TriangleMesh.build_regular(self.x_mm, self.y_mm).triangles
        return replace(self, screen_mm=_turn_back(screen_mm, triangles))

    def on_lattice(self, values: Array, x_mm: Array, y_mm: Array) -> Array:
        """Return (ny, nx, k) values (my, mx, k) of the vertices at screen points (x_mm[i], y_mm[j])."""
        return _read(values, *screen_positions(self.screen_mm[..., 0], self.screen_mm[..., 1], x_mm, y_mm))


def flow_on_even_grids(
    target: Array,
    *,
    size_mm: tuple[float, float],
    lens_cells: tuple[int, int],
    settings: FlowSettings,
    on_progress: Progress | None = None,
) -> PaperFlow:
    """Run solve_paper_map for remeshing = "clean"; lens_cells (x, y) of the grid it ends on."""
    ny, nx = target.shape
    wanted, lifted = raise_to_floor(target, settings.floor)
    run = _Run(wanted, size_mm, settings, on_progress)
    state = None
    for share in _COARSER:
        cells = (max(lens_cells[0] // share, 2), max(lens_cells[1] // share, 2))
        if share > 1 and min(cells) < _LEAST_CELLS:
            continue
        state = _Even.identity(size_mm, cells) if state is None else state.refine(cells)
        state = run.settle(state, last=share == 1)
    assert state is not None
    pair = state.pair()
    x_mm, y_mm = pixel_vertices(nx, size_mm[0]), pixel_vertices(ny, size_mm[1])
    if len(run.steps) not in KEPT_STEPS:
        run.show(len(run.steps), state, pair)
    lens_mm = pair.lens.points_mm.reshape(*state.screen_mm.shape)
    if on_progress is not None:
        on_progress("flow", 1.0)
    return PaperFlow(
        x_mm=x_mm,
        y_mm=y_mm,
        lens_mm=state.on_lattice(lens_mm, x_mm, y_mm),
        lens_step=len(run.steps),
        target=wanted,
        converged=run.settled,
        message=join(" ", (run.message(), *floor_notes(lifted, settings.floor))),
        steps=tuple(run.steps),
        snapshots=tuple(run.snapshots),
        pair=pair,
        remeshing="clean",
    )


class _Run:
    """The steps over all grids, and their record."""

    def __init__(
        self, wanted: Array, size_mm: tuple[float, float], settings: FlowSettings, on_progress: Progress | None
    ) -> None:
        self._wanted, self._size_mm, self._settings, self._on_progress = wanted, size_mm, settings, on_progress
        self.steps: list[FlowStep] = []
        self.snapshots: list[FlowSnapshot] = []
        self.rms, self.settled = np.inf, False

    def settle(self, state: _Even, *, last: bool) -> _Even:
        """Take steps on one grid until they no longer help; return the best state on the even grid."""
        start = state.pair()
        poisson, across = NeumannPoisson(start.lens), neighbours_of(start.triangles)
        shape = state.screen_mm.shape[:2]
        pair, best, since, all_rms = start, state, 0, list[float]()
        best_rms, self.settled = np.inf, False
        while True:
            excess, faces = excess_on_faces(pair, across, self._wanted, self._size_mm), pair.screen.dual_areas()
            rms = rms_over(excess / faces, faces)
            all_rms.append(rms)
            if since == 0 and rms < best_rms:
                best, best_rms = state, rms
            self.settled = rms <= self._settings.converged_rms or _is_stalled(all_rms, _GAIN if last else _COARSE_GAIN)
            if since == 0 and (self.settled or len(self.steps) >= self._settings.max_steps):
                self.rms = best_rms
                return best
            solution = poisson.solve(pair.lens, excess, tolerance=self._settings.solver_tolerance)
            velocity = project_to_frame(pair.lens.vertex_gradients(solution.values, pair.lens.areas()), shape)
            largest_dt = pair.lens.largest_step(velocity)
            dt = min(0.5 * largest_dt, 1.0)
            pair = MeshPair(screen=pair.screen, lens=pair.lens.move_to(pair.lens.points_mm + dt * velocity))
            since += 1
            again = dt < _SHORT_STEP or since == _MOST_BETWEEN or self.settled
            if again:
                state, since = state.regrid(pair.lens.points_mm.reshape(*shape, 2)), 0
                pair = state.pair()
            self._record(state, pair, across, dt, largest_dt, again)

    def message(self) -> Phrase:
        return Phrase(
            "{end}: rms difference {percent:.2f} % of the mean after {count} steps, {remeshings} of them ended on an "
            "even grid again.",
            end=Phrase("The flow has settled") if self.settled else Phrase("The flow was stopped at its limit"),
            percent=100.0 * self.rms,
            count=len(self.steps),
            remeshings=sum(step.remeshed for step in self.steps),
        )

    def _record(
        self,
        state: _Even,
        pair: MeshPair,
        across: Neighbours,
        dt: float,
        largest_dt: float,
        remeshed: bool,
    ) -> None:
        faces = pair.screen.dual_areas()
        difference = excess_on_faces(pair, across, self._wanted, self._size_mm) / faces
        step = FlowStep(
            step=len(self.steps) + 1,
            dt=dt,
            largest_dt=min(largest_dt, 1e9),
            rms_percent=100.0 * rms_over(difference, faces),
            max_percent=100.0 * float(np.abs(difference).max()),
            remeshed=remeshed,
        )
        self.steps.append(step)
        if step.step in KEPT_STEPS:
            self.show(step.step, state, pair)
        if self._on_progress is not None:
            self._on_progress("flow", min(0.99, len(self.steps) / self._settings.max_steps))

    def show(self, number: int, state: _Even, pair: MeshPair) -> None:
        """Keep a snapshot: the mesh `pair`, moved from the even grid `state`, read at the pixels."""
        ny, nx = self._wanted.shape
        excess = excess_on_faces(pair, neighbours_of(pair.triangles), self._wanted, self._size_mm)
        difference = excess / pair.screen.dual_areas()
        values = np.column_stack([pair.lens.points_mm, difference]).reshape(*state.screen_mm.shape[:2], 3)
        x_mm, y_mm = pixel_vertices(nx, self._size_mm[0]), pixel_vertices(ny, self._size_mm[1])
        grid = state.on_lattice(values, x_mm, y_mm)
        self.snapshots.append(FlowSnapshot(step=number, difference=grid[..., 2], lens_mm=grid[..., :2]))


def _is_stalled(rms: list[float], gain: float) -> bool:
    return len(rms) > _STALLED_STEPS and min(rms[-_STALLED_STEPS:]) > (1.0 - gain) * min(rms[:-_STALLED_STEPS])


def _read(values: Array, u: Array, v: Array, *, order: int = 1) -> Array:
    """Return bilinear (or cubic) values (my, mx, k) at fractional indices u along columns and v along rows, both (ny,
    nx).
    """
    layers = (values[..., k] for k in range(values.shape[-1]))
    return np.stack([map_coordinates(layer, [v, u], order=order, mode="nearest") for layer in layers], axis=-1)


def _turn_back(screen_mm: Array, triangles: Triangles) -> Array:
    """Return screen points (my, mx, 2) with no triangle turned over, by averaging vertices with their neighbours."""
    shape = screen_mm.shape
    for _ in range(_UNTURNING_ROUNDS):
        areas = TriangleMesh(points_mm=np.ascontiguousarray(screen_mm.reshape(-1, 2)), triangles=triangles).areas()
        bad = areas <= _LEAST_ON_SCREEN * areas.mean()
        if not bad.any():
            break
        hit = np.zeros(shape[0] * shape[1], dtype=bool)
        hit[triangles[bad].ravel()] = True
        screen_mm = np.where(hit.reshape(shape[:2])[..., None], 0.5 * (screen_mm + _means(screen_mm)), screen_mm)
    return screen_mm


def _means(points: Array) -> Array:
    """Return the mean of the four neighbours; on the frame of the two along it; corners stay."""
    means = points.copy()
    means[1:-1, 1:-1] = 0.25 * (points[2:, 1:-1] + points[:-2, 1:-1] + points[1:-1, 2:] + points[1:-1, :-2])
    for rim in (0, -1):
        means[rim, 1:-1] = 0.5 * (points[rim, 2:] + points[rim, :-2])
        means[1:-1, rim] = 0.5 * (points[2:, rim] + points[:-2, rim])
    return means
