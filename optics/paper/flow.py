"""The paper's transport flow (section 3.1): a triangle mesh that moves until every dual face holds its light.

Each vertex stands for one pixel q of the screen and moves over the lens: its place p says where the pixel's light comes
from. A step takes D = L J - C (Eq. 2), J being the vertex's dual area on the lens over its dual area on the screen;
solves Poisson's equation for phi on the mesh as it now lies (Eq. 3); and moves the vertices by grad(phi) dt (Eq. 4).

Details that the paper leaves open, and our choices:
- The source of the Poisson equation is the excess light of each dual face, D times its area on the screen. The sources
  then add up to zero exactly, and dt = 1 is a full Newton step for L J = C: moving by grad(phi) changes a face by
  (its area) x laplace(phi) dt. Reading D as a density per area of the lens instead overshoots where J > 2 (a bright
  spot of 14 times the mean never settles).
- grad(phi) at a vertex is the mean over its triangles weighted by their areas on the *screen*. With areas on the lens
  the big bright triangles pull thin ones flat, and photographs stick at up to 1.4 times the difference.
- dt is half the largest step that flips no triangle, as in the paper, and never more than the Newton step.
- The mean over triangles cannot see a checkerboard, so D keeps the part of it that alternates from pixel to pixel.
- A mesh that is stuck or has settled still goes on to step 25, the last one of the paper's Fig. 6. The lens uses the
  mesh where it got stuck: later steps gain less than a percent, and their triangles are too thin to solve a surface on.
- Vertices stand on the centres of their pixels, so that faces are pixels; the outermost ones stand on the frame, where
  only the component along it is followed. Zero intensity has no continuous map: the target is lifted to a floor.

`FlowSettings.remeshing` decides about a mesh that gets stuck: nothing (here, as in the paper's section 4), vertices cut
out and darts thrown (flow_darts, its section 5), or an even grid again (flow_even).
"""

from __future__ import annotations

import numpy as np

from optics.paper.flow_darts import flow_with_darts
from optics.paper.flow_even import flow_on_even_grids
from optics.paper.flow_rules import (
    KEPT_STEPS,
    STUCK_DT,
    FlowSettings,
    FlowSnapshot,
    FlowStep,
    PaperFlow,
    Progress,
    Remeshing,
    check_target,
    face_intensities,
    floor_notes,
    judge_convergence,
    pixel_vertices,
    project_to_frame,
    rms_over,
)
from optics.paper.mesh import MeshPair, TriangleMesh
from optics.paper.poisson import NeumannPoisson
from optics.spline import Array
from phrases.phrase import Phrase, join

__all__ = [
    "FlowSettings",
    "FlowSnapshot",
    "FlowStep",
    "PaperFlow",
    "Remeshing",
    "pixel_vertices",
    "project_to_frame",
    "solve_paper_map",
]


def solve_paper_map(
    target: Array,
    *,
    width_mm: float,
    height_mm: float,
    settings: FlowSettings | None = None,
    lens_cells: tuple[int, int] | None = None,
    on_progress: Progress | None = None,
) -> PaperFlow:
    """Move the mesh until the lens sends every pixel its light, or until a triangle stops it.

    target (ny, nx) : irradiance in the work frame (row 0 = lowest y), at least 4 x 4, mean 1 up to scale
    lens_cells      : (x, y) of the even grid that "clean" remeshing ends on; two a pixel by default
    errors          : TargetError if the target is too small, negative, not finite or dark
    """
    settings = settings or FlowSettings()
    check_target(target)
    size_mm = (width_mm, height_mm)
    if settings.remeshing == "simple":
        return flow_with_darts(target, size_mm=size_mm, settings=settings, on_progress=on_progress)
    if settings.remeshing == "clean":
        cells = lens_cells or (2 * target.shape[1], 2 * target.shape[0])
        return flow_on_even_grids(target, size_mm=size_mm, lens_cells=cells, settings=settings, on_progress=on_progress)
    return _plain_flow(target, size_mm, settings, on_progress)


def _plain_flow(
    target: Array, size_mm: tuple[float, float], settings: FlowSettings, on_progress: Progress | None
) -> PaperFlow:
    ny, nx = target.shape
    x_mm, y_mm = pixel_vertices(nx, size_mm[0]), pixel_vertices(ny, size_mm[1])
    rest = TriangleMesh.build_regular(x_mm, y_mm)
    faces, weights = rest.dual_areas(), rest.areas()
    wanted, lifted = face_intensities(target, faces, settings.floor)

    poisson = NeumannPoisson(rest)
    mesh = rest
    difference = mesh.dual_areas() / faces - wanted
    steps: list[FlowStep] = []
    snapshots: list[FlowSnapshot] = []
    lens, lens_step = rest, 0
    verdict: tuple[bool, Phrase] | None = judge_convergence(steps, rms_over(difference, faces), settings)
    while verdict is None:
        solution = poisson.solve(mesh, difference * faces, tolerance=settings.solver_tolerance)
        velocity = project_to_frame(mesh.vertex_gradients(solution.values, weights), (ny, nx))
        largest_dt = mesh.largest_step(velocity)
        dt = min(0.5 * largest_dt, 1.0)
        mesh = mesh.move_to(mesh.points_mm + dt * velocity)
        if dt >= STUCK_DT or not any(step.dt < STUCK_DT for step in steps):
            lens, lens_step = mesh, len(steps) + 1
        difference = mesh.dual_areas() / faces - wanted
        rms = rms_over(difference, faces)
        steps.append(
            FlowStep(
                step=len(steps) + 1,
                dt=dt,
                largest_dt=min(largest_dt, 1e9),
                rms_percent=100.0 * rms,
                max_percent=100.0 * float(np.abs(difference).max()),
            )
        )
        verdict = judge_convergence(steps, rms, settings)
        if steps[-1].step in KEPT_STEPS or verdict is not None:
            field, lens_mm = difference.reshape(ny, nx), mesh.points_mm.reshape(ny, nx, 2)
            snapshots.append(FlowSnapshot(step=steps[-1].step, difference=field, lens_mm=lens_mm))
        if on_progress is not None:
            on_progress("flow", 1.0 if verdict is not None else min(0.99, len(steps) / settings.max_steps))
    converged, message = verdict
    return PaperFlow(
        x_mm=x_mm,
        y_mm=y_mm,
        lens_mm=lens.points_mm.reshape(ny, nx, 2),
        lens_step=lens_step,
        target=wanted.reshape(ny, nx),
        converged=converged,
        message=join(" ", (message, *floor_notes(lifted, settings.floor))),
        steps=tuple(steps),
        snapshots=tuple(snapshots),
        pair=MeshPair(screen=rest, lens=lens),
    )
