"""The paper's transport flow (section 3.1): a triangle mesh that moves until every dual face holds its light.

Each vertex stands for one pixel q of the screen and moves over the lens: its place p says where the pixel's light comes
from. A step takes D = L J - C (Eq. 2), J being the vertex's dual area on the lens over its dual area on the screen;
solves Poisson's equation for phi on the mesh as it now lies (Eq. 3); and moves the vertices by grad(phi) dt (Eq. 4).

What the paper leaves open, and what is done here:
- The source of the Poisson equation is the excess light of each dual face, D times its area on the screen. The sources
  then add up to zero exactly, and dt = 1 is a full Newton step for L J = C: moving by grad(phi) changes a face by
  (its area) x laplace(phi) dt. Reading D as a density per area of the lens instead overshoots where J > 2 (a bright
  spot of 14 times the mean never settles).
- grad(phi) at a vertex is the mean over its triangles weighted by their areas on the *screen*. With areas on the lens
  the big bright triangles pull thin ones flat, and photographs stick at up to 1.4 times the difference.
- dt is half the largest step that flips no triangle, as in the paper, and never more than the Newton step.
- The mean over triangles cannot see a checkerboard, so D keeps the part of it that alternates from pixel to pixel.
- A mesh that is stuck or has settled still goes on to step 25, the last one of the paper's Fig. 6. The lens is made
  where it got stuck: later steps gain less than a percent, and their triangles are too thin to solve a surface on.
- Vertices stand on the centres of their pixels, so that faces are pixels; the outermost ones stand on the frame, where
  only the component along it is followed. Zero intensity has no continuous map: the target is lifted to a floor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np

from optics.errors import TargetError
from optics.mesh import TriangleMesh
from optics.poisson import NeumannPoisson
from optics.spline import Array

Progress = Callable[[str, float], None]

KEPT_STEPS = (1, 3, 5, 7, 25)  # of the paper's Fig. 6; and the last


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowSettings:
    """When the flow stops, and how little light it aims at."""

    max_steps: int = 60
    converged_rms: float = 0.0025  # rms of D over the mean intensity
    settled_gain: float = 0.02  # converged, too, once full steps lower the rms by less than this share ...
    settled_steps: int = 3  # ... so many times running: what is left is finer than the mesh can move
    stuck_dt: float = 5e-3  # a step this small moves nothing worth while: stuck ...
    least_steps: int = 25  # ... yet the flow goes on so far, for the paper's figure ...
    immovable_dt: float = 1e-9  # ... unless the mesh cannot move at all
    floor: float = 0.01  # least target, as a share of the mean
    solver_tolerance: float = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowStep:
    """The state after a step; D in percent of the mean intensity."""

    step: int
    dt: float
    largest_dt: float  # at which the first triangle would flip
    rms_percent: float
    max_percent: float
    thinnest: float  # smallest triangle on the lens over the same triangle on the screen
    solver_iterations: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlowSnapshot:
    """What Fig. 6 shows of one step: D (ny, nx), mean intensity 1, and the moved vertices (ny, nx, 2)."""

    step: int
    difference: Array
    lens_mm: Array

    def isoparametric_lines(self, count: int = 32) -> Iterator[Array]:
        """About `count` polylines (k, 2) each way: images of lines of constant screen x and y, frame included."""
        ny, nx = self.difference.shape
        for j in np.unique(np.linspace(0, ny - 1, count + 1).round().astype(int)):
            yield self.lens_mm[j]
        for i in np.unique(np.linspace(0, nx - 1, count + 1).round().astype(int)):
            yield self.lens_mm[:, i]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperFlow:
    """The mapping q -> p: screen vertices (x_mm (nx,), y_mm (ny,)), in lens units, to lens_mm (ny, nx, 2).

    x_mm and y_mm span the aperture; a screen of another size is the same grid, scaled. `target` (ny, nx) is the
    intensity C aimed at, floor included. Not converged means: light is misplaced by D, but the map is one-to-one.
    """

    x_mm: Array
    y_mm: Array
    lens_mm: Array
    lens_step: int  # after which the mesh lay like this
    target: Array
    converged: bool
    message: str
    steps: tuple[FlowStep, ...]
    snapshots: tuple[FlowSnapshot, ...]

    def history(self) -> list[dict[str, float]]:
        """One JSON-able dict per step."""
        return [asdict(step) for step in self.steps]

    def corners_mm(self) -> tuple[Array, Array]:
        """Pixel corners on the (aperture-sized) screen and their points on the lens, both (ny + 1, nx + 1, 2).

        Bilinear between vertices: the rim stays on the frame and no corner leaves the quad of its neighbours.
        """
        ny, nx = self.target.shape
        x = np.linspace(self.x_mm[0], self.x_mm[-1], nx + 1)
        y = np.linspace(self.y_mm[0], self.y_mm[-1], ny + 1)
        along = _interpolation(self.x_mm, x)
        across = _interpolation(self.y_mm, y)
        lens = np.einsum("ab,bcd,ec->aed", across, self.lens_mm, along, optimize=True)
        return np.stack(np.meshgrid(x, y), axis=-1), lens


def solve_paper_map(
    target: Array,
    *,
    width_mm: float,
    height_mm: float,
    settings: FlowSettings | None = None,
    on_progress: Progress | None = None,
) -> PaperFlow:
    """Move the mesh until the lens sends every pixel its light, or until a triangle is in the way.

    target (ny, nx) : irradiance in the work frame (row 0 = lowest y), at least 4 x 4, mean 1 up to scale
    errors          : TargetError if the target is too small, negative, not finite or dark
    """
    settings = settings or FlowSettings()
    _check(target)
    ny, nx = target.shape
    x_mm, y_mm = pixel_vertices(nx, width_mm), pixel_vertices(ny, height_mm)
    rest = TriangleMesh.structured(x_mm, y_mm)
    faces, weights = rest.dual_areas(), rest.areas()
    wanted, lifted = _face_intensities(target, faces, settings.floor)

    poisson = NeumannPoisson(rest)
    mesh = rest
    difference = mesh.dual_areas() / faces - wanted
    steps: list[FlowStep] = []
    snapshots: list[FlowSnapshot] = []
    lens, lens_step = rest, 0
    verdict: tuple[bool, str] | None = _verdict(steps, _rms(difference, faces), settings)
    while verdict is None:
        solution = poisson.solve(mesh, difference * faces, tolerance=settings.solver_tolerance)
        velocity = held_to_the_frame(mesh.vertex_gradients(solution.values, weights), (ny, nx))
        largest_dt = mesh.largest_step(velocity)
        dt = min(0.5 * largest_dt, 1.0)
        mesh = mesh.moved(mesh.points_mm + dt * velocity)
        if dt >= settings.stuck_dt or not any(step.dt < settings.stuck_dt for step in steps):
            lens, lens_step = mesh, len(steps) + 1
        difference = mesh.dual_areas() / faces - wanted
        rms = _rms(difference, faces)
        steps.append(
            FlowStep(
                step=len(steps) + 1,
                dt=dt,
                largest_dt=min(largest_dt, 1e9),
                rms_percent=100.0 * rms,
                max_percent=100.0 * float(np.abs(difference).max()),
                thinnest=float((mesh.areas() / weights).min()),
                solver_iterations=solution.iterations,
            )
        )
        verdict = _verdict(steps, rms, settings)
        if steps[-1].step in KEPT_STEPS or verdict is not None:
            snapshots.append(_snapshot(steps[-1].step, difference, mesh, (ny, nx)))
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
        message=message + _floor_note(lifted, settings.floor),
        steps=tuple(steps),
        snapshots=tuple(snapshots),
    )


def pixel_vertices(pixels: int, length_mm: float) -> Array:
    """One vertex per pixel of a row: on the pixel's centre, but the first and last on the frame."""
    centres = (np.arange(pixels, dtype=np.float64) + 0.5) * (length_mm / pixels)
    centres[0], centres[-1] = 0.0, length_mm
    return np.asarray(centres)


def held_to_the_frame(velocity: Array, shape: tuple[int, int]) -> Array:
    """(n, 2) velocities with no component across the frame; corners stand still."""
    field = velocity.reshape(*shape, 2).copy()
    field[:, 0, 0] = field[:, -1, 0] = 0.0
    field[0, :, 1] = field[-1, :, 1] = 0.0
    return field.reshape(-1, 2)


def _check(target: Array) -> None:
    if target.ndim != 2 or min(target.shape) < 4:
        raise TargetError(f"the paper's method needs a target of at least 4 x 4 pixels, not {target.shape}")
    if not np.isfinite(target).all() or target.min() < 0.0 or target.sum() <= 0.0:
        raise TargetError("the target must be finite, nowhere negative and not all dark")


def _face_intensities(target: Array, faces: Array, floor: float) -> tuple[Array, float]:
    """C per vertex (n,), floored, its total light exactly that of the aperture; and the share of faces lifted.

    A face is its pixel, except beside the frame: there the outermost pixel is shared by two faces, by area.
    """
    ny, nx = target.shape
    means = _face_overlaps(ny) @ target @ _face_overlaps(nx).T
    values = means.ravel() / (np.dot(means.ravel(), faces) / faces.sum())
    lifted = float(np.mean(values < floor))
    values = np.maximum(values, floor)
    return values * (faces.sum() / np.dot(values, faces)), lifted


def _face_overlaps(pixels: int) -> Array:
    """(pixels, pixels): row i holds the shares of each pixel in the face of vertex i, along one axis."""
    vertices = pixel_vertices(pixels, float(pixels))
    bounds = np.concatenate([[0.0], 0.5 * (vertices[1:] + vertices[:-1]), [float(pixels)]])
    edges = np.arange(pixels + 1.0)
    low = np.maximum(bounds[:-1, None], edges[None, :-1])
    high = np.minimum(bounds[1:, None], edges[None, 1:])
    return np.maximum(high - low, 0.0) / np.diff(bounds)[:, None]


def _interpolation(nodes: Array, at: Array) -> Array:
    """(at.size, nodes.size) matrix of linear interpolation."""
    return np.stack([np.interp(at, nodes, column) for column in np.eye(nodes.size)], axis=1)


def _rms(difference: Array, faces: Array) -> float:
    return float(np.sqrt(np.dot(faces, difference**2) / faces.sum()))


def _verdict(steps: list[FlowStep], rms: float, settings: FlowSettings) -> tuple[bool, str] | None:
    """Whether to stop, and the sentence why; None goes on."""
    state = f"rms difference {100.0 * rms:.2f} % of the mean after {len(steps)} steps"
    if rms <= settings.converged_rms:
        return True, f"The flow converged: {state}."
    recent = steps[-settings.settled_steps - 1 :]
    gains = [1.0 - b.rms_percent / a.rms_percent for a, b in pairwise(recent)]
    full = all(step.dt == 1.0 for step in recent[1:])
    shown = len(steps) >= min(settings.least_steps, settings.max_steps)
    if shown and full and len(gains) == settings.settled_steps and max(gains) < settings.settled_gain:
        return True, f"The flow has settled: {state}; what is left is finer than the mesh can move."
    if steps and steps[-1].dt < (settings.stuck_dt if shown else settings.immovable_dt):
        return False, (
            f"The mesh got stuck: {state}; the next triangle to flip allows a step of only {steps[-1].largest_dt:.1e} "
            "(a bright region beside a very dark one). The lens shows the picture with less contrast than asked for."
        )
    if len(steps) >= settings.max_steps:
        return False, f"The flow was stopped at its limit of {settings.max_steps} steps: {state}."
    return None


def _snapshot(step: int, difference: Array, mesh: TriangleMesh, shape: tuple[int, int]) -> FlowSnapshot:
    return FlowSnapshot(step=step, difference=difference.reshape(shape), lens_mm=mesh.points_mm.reshape(*shape, 2))


def _floor_note(lifted: float, floor: float) -> str:
    if lifted == 0.0:
        return ""
    return (
        f" {100.0 * lifted:.1f} % of the picture is darker than {100.0 * floor:g} % of its mean and was lifted "
        "to that: this method cannot make black."
    )
