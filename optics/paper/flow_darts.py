"""The paper's flow with its simple remeshing: a step starts with cutting out the triangles that would flip soon."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import Delaunay

from optics.paper.flow_rules import (
    KEPT_STEPS,
    FlowSettings,
    FlowSnapshot,
    FlowStep,
    PaperFlow,
    Progress,
    excess_on_faces,
    floor_notes,
    judge_convergence,
    pixel_vertices,
    raise_to_floor,
    rms_over,
)
from optics.paper.mesh import MeshPair, TriangleMesh
from optics.paper.mesh_surgery import neighbours_of
from optics.paper.poisson import NeumannPoisson
from optics.paper.remesh import without_short_lived
from optics.spline import Array
from phrases.phrase import Phrase, join

_SHORT_LIFE = 0.2  # a triangle that flips within this time is cut out
_SEED = 20140301  # of the darts


def flow_with_darts(
    target: Array, *, size_mm: tuple[float, float], settings: FlowSettings, on_progress: Progress | None = None
) -> PaperFlow:
    """Run solve_paper_map for remeshing = "simple"."""
    ny, nx = target.shape
    wanted, lifted = raise_to_floor(target, settings.floor)
    x_mm, y_mm = pixel_vertices(nx, size_mm[0]), pixel_vertices(ny, size_mm[1])
    rest = TriangleMesh.build_regular(x_mm, y_mm)
    pair = MeshPair(screen=rest, lens=rest)
    rng = np.random.default_rng(_SEED)
    pixel_mm = (size_mm[0] / nx, size_mm[1] / ny)
    steps: list[FlowStep] = []
    snapshots: list[FlowSnapshot] = []
    excess, faces = excess_on_faces(pair, neighbours_of(pair.triangles), wanted, size_mm), rest.dual_areas()
    verdict = judge_convergence(steps, rms_over(excess / faces, faces), settings)
    while verdict is None:
        solution = NeumannPoisson(pair.lens).solve(pair.lens, excess, tolerance=settings.solver_tolerance)
        velocity = _project_to_frame(pair.lens.vertex_gradients(solution.values, pair.screen.areas()), pair, size_mm)
        removed = inserted = 0
        if pair.lens.largest_step(velocity) < _SHORT_LIFE:
            made = without_short_lived(pair, velocity, wanted=_SHORT_LIFE, pixel_mm=pixel_mm, rng=rng)
            pair, velocity, removed, inserted = made.pair, made.velocity_mm, made.removed, made.inserted
        largest_dt = pair.lens.largest_step(velocity)
        dt = min(0.5 * largest_dt, 1.0)
        pair = MeshPair(screen=pair.screen, lens=pair.lens.move_to(pair.lens.points_mm + dt * velocity))
        faces = pair.screen.dual_areas()
        excess = excess_on_faces(pair, neighbours_of(pair.triangles), wanted, size_mm)
        difference = excess / faces
        steps.append(
            FlowStep(
                step=len(steps) + 1,
                dt=dt,
                largest_dt=min(largest_dt, 1e9),
                rms_percent=100.0 * rms_over(difference, faces),
                max_percent=100.0 * float(np.abs(difference).max()),
                removed=removed,
                inserted=inserted,
            )
        )
        verdict = judge_convergence(steps, rms_over(difference, faces), settings)
        if steps[-1].step in KEPT_STEPS or verdict is not None:
            field = on_lattice(pair, difference[:, None], x_mm, y_mm)[..., 0]
            lens_mm = _lens_lattice(pair, x_mm, y_mm)
            snapshots.append(FlowSnapshot(step=steps[-1].step, difference=field, lens_mm=lens_mm))
        if on_progress is not None:
            on_progress("flow", 1.0 if verdict is not None else min(0.99, len(steps) / settings.max_steps))
    converged, message = verdict
    return PaperFlow(
        x_mm=x_mm,
        y_mm=y_mm,
        lens_mm=_lens_lattice(pair, x_mm, y_mm),
        lens_step=len(steps),
        target=wanted,
        converged=converged,
        message=join(" ", (message, _note_remeshing(steps), *floor_notes(lifted, settings.floor))),
        steps=tuple(steps),
        snapshots=tuple(snapshots),
        pair=pair,
        remeshing="simple",
    )


def _lens_lattice(pair: MeshPair, x_mm: Array, y_mm: Array) -> Array:
    """Return (ny, nx, 2) points on the lens of the lattice of pixels, none across the frame."""
    lens_mm = on_lattice(pair, pair.lens.points_mm, x_mm, y_mm)
    lens_mm[:, 0, 0], lens_mm[:, -1, 0] = x_mm[0], x_mm[-1]
    lens_mm[0, :, 1], lens_mm[-1, :, 1] = y_mm[0], y_mm[-1]
    return lens_mm


def on_lattice(pair: MeshPair, values: Array, x_mm: Array, y_mm: Array) -> Array:
    """Return (ny, nx, k) values (n, k) of the vertices at the lattice of pixels: a C1 cubic over the screen, exact at
    them.

    A vertex that was never removed still stands on its pixel; between those that were, scipy's Clough-Tocher elements.
    """
    points = pair.screen.points_mm
    column = np.searchsorted(x_mm, points[:, 0]).clip(max=x_mm.size - 1)
    row = np.searchsorted(y_mm, points[:, 1]).clip(max=y_mm.size - 1)
    there = (x_mm[column] == points[:, 0]) & (y_mm[row] == points[:, 1])
    grid = np.full((y_mm.size, x_mm.size, values.shape[1]), np.nan)
    grid[row[there], column[there]] = values[there]
    missing = np.isnan(grid[..., 0])
    if missing.any():
        smooth = CloughTocher2DInterpolator(Delaunay(points), values)
        grid[missing] = smooth(np.stack(np.meshgrid(x_mm, y_mm), axis=-1)[missing])
    return grid


def _project_to_frame(velocity: Array, pair: MeshPair, size_mm: tuple[float, float]) -> Array:
    """Return velocities without a component across the frame."""
    for axis in (0, 1):
        on_frame = (pair.screen.points_mm[:, axis] == 0.0) | (pair.screen.points_mm[:, axis] == size_mm[axis])
        velocity[on_frame, axis] = 0.0
    return velocity


def _note_remeshing(steps: list[FlowStep]) -> Phrase:
    removed, inserted = sum(step.removed for step in steps), sum(step.inserted for step in steps)
    return Phrase("Remeshing removed {removed} vertices and inserted {inserted}.", removed=removed, inserted=inserted)
