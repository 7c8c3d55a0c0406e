"""The common parts of all variants of the paper's flow: settings, steps, snapshots and the resulting mapping; and rules
for the aim, for D, and for stopping.

On a remeshed lens D needs the light of the picture on the dual faces of any triangle mesh: exact, by Green's formula
along the faces' sides. The integral of T over a polygon is the integral of F dy along its outline, F(x, y) = int_0^x T.
Pixels are constant, so on each piece of a side within one pixel the midpoint of F is exact. A side between two faces is
visited once and added to one of them and subtracted from the other: the faces' light adds up to the picture's to
rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optics.errors import TargetError
from optics.paper.mesh import MeshPair, TriangleMesh, Triangles
from optics.paper.mesh_surgery import Neighbours
from optics.spline import Array
from phrases.phrase import Phrase

Progress = Callable[[str, float], None]
Remeshing = Literal["none", "simple", "clean"]

STUCK_DT = 5e-3  # a step this small has no effect: stuck ...
_LEAST_STEPS = 25  # ... but the flow goes on until this step, for the paper's figure ...
_IMMOVABLE_DT = 1e-9  # ... unless the mesh cannot move at all
_SETTLED_GAIN = 0.02  # also converged once full steps lower the rms by less than this share ...
_SETTLED_STEPS = 3  # ... this many times in a row: the rest is finer than the mesh can resolve
KEPT_STEPS = (1, 3, 5, 7, 25)  # of the paper's Fig. 6; and the last


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowSettings:
    """When the flow stops, its least target light, and its treatment of a mesh that gets stuck.

    remeshing : "none", as in the paper's section 4; "simple", its section 5 (see optics.paper.flow_darts); "clean", its
                future work (see optics.paper.flow_even)
    """

    max_steps: int = 60
    converged_rms: float = 0.0025  # rms of D over the mean intensity
    floor: float = 0.01  # least target, as a share of the mean
    solver_tolerance: float = 1e-4
    remeshing: Remeshing = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowStep:
    """The state after a step; D in percent of the mean intensity."""

    step: int
    dt: float
    largest_dt: float  # at which the first triangle would flip
    rms_percent: float
    max_percent: float
    removed: int = 0  # vertices taken out by remeshing before the step
    inserted: int = 0
    remeshed: bool = False  # "clean": put back on an even grid after the step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlowSnapshot:
    """The data of Fig. 6 for one step: D (ny, nx), mean intensity 1, and the moved vertices (ny, nx, 2)."""

    step: int
    difference: Array
    lens_mm: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperFlow:
    """The mapping q -> p: screen vertices (x_mm (nx,), y_mm (ny,)), in lens units, to lens_mm (ny, nx, 2).

    x_mm and y_mm span the aperture; a screen of another size is the same grid, scaled. `target` (ny, nx) is the
    intended intensity C, floor included. Not converged means: light is misplaced by D, but the map is one-to-one.
    `pair` is the mesh in both planes: that of x_mm, y_mm and lens_mm without remeshing, any other with it.
    """

    x_mm: Array
    y_mm: Array
    lens_mm: Array
    lens_step: int  # after which the mesh had this state
    target: Array
    converged: bool
    message: Phrase
    steps: tuple[FlowStep, ...]
    snapshots: tuple[FlowSnapshot, ...]
    pair: MeshPair
    remeshing: Remeshing = "none"

    def history(self) -> list[dict[str, float]]:
        """Return one JSON-able dict per step."""
        return [asdict(step) for step in self.steps]

    def corners_mm(self) -> tuple[Array, Array]:
        """Return pixel corners on the (aperture-sized) screen and their points on the lens, both (ny + 1, nx + 1, 2).

        Bilinear between vertices: the rim stays on the frame and no corner leaves the quad of its neighbours.
        """
        ny, nx = self.target.shape
        x = np.linspace(self.x_mm[0], self.x_mm[-1], nx + 1)
        y = np.linspace(self.y_mm[0], self.y_mm[-1], ny + 1)
        along = _interpolation(self.x_mm, x)
        across = _interpolation(self.y_mm, y)
        lens = np.einsum("ab,bcd,ec->aed", across, self.lens_mm, along, optimize=True)
        return np.stack(np.meshgrid(x, y), axis=-1), lens


def pixel_vertices(pixels: int, length_mm: float) -> Array:
    """Return one vertex per pixel of a row: on the pixel's centre, but the first and last on the frame."""
    centres = (np.arange(pixels, dtype=np.float64) + 0.5) * (length_mm / pixels)
    centres[0], centres[-1] = 0.0, length_mm
    return np.asarray(centres)


def _interpolation(nodes: Array, at: Array) -> Array:
    """Return (at.size, nodes.size) matrix of linear interpolation."""
    return np.stack([np.interp(at, nodes, column) for column in np.eye(nodes.size)], axis=1)


def project_to_frame(velocity: Array, shape: tuple[int, int]) -> Array:
    """Return (n, 2) velocities with no component across the frame; corners stand still."""
    field = velocity.reshape(*shape, 2).copy()
    field[:, 0, 0] = field[:, -1, 0] = 0.0
    field[0, :, 1] = field[-1, :, 1] = 0.0
    return field.reshape(-1, 2)


def excess_on_faces(pair: MeshPair, across: Neighbours, target: Array, size_mm: tuple[float, float]) -> Array:
    """Return (n,) the excess light of each face of a remeshed lens over the target of its face on the screen [mm^2]: D
    x area.
    """
    return pair.lens.dual_areas() - face_light(pair.screen, across, target, size_mm)


def check_target(target: Array) -> None:
    if target.ndim != 2 or min(target.shape) < 4:
        raise TargetError(
            Phrase("the paper's method needs a target of at least 4 x 4 pixels, not {size}", size=target.shape)
        )
    if not np.isfinite(target).all() or target.min() < 0.0 or target.sum() <= 0.0:
        raise TargetError(Phrase("the target must be finite, nowhere negative and not all dark"))


def face_intensities(target: Array, faces: Array, floor: float) -> tuple[Array, float]:
    """Return C per vertex (n,), floored, its total light exactly that of the aperture; and the share of faces lifted.

    A face is its pixel, except beside the frame: there the outermost pixel is shared by two faces, by area.
    """
    ny, nx = target.shape
    means = _face_overlaps(ny) @ target @ _face_overlaps(nx).T
    values = means.ravel() / (np.dot(means.ravel(), faces) / faces.sum())
    lifted = float(np.mean(values < floor))
    values = np.maximum(values, floor)
    return values * (faces.sum() / np.dot(values, faces)), lifted


def raise_to_floor(target: Array, floor: float) -> tuple[Array, float]:
    """Return the target with mean 1 and nowhere below `floor`, and the share of its pixels that was lifted."""
    values = target / target.mean()
    lifted = float(np.mean(values < floor))
    values = np.maximum(values, floor)
    return np.asarray(values / values.mean()), lifted


def _face_overlaps(pixels: int) -> Array:
    """Return (pixels, pixels): row i holds the shares of each pixel in the face of vertex i, along one axis."""
    vertices = pixel_vertices(pixels, float(pixels))
    bounds = np.concatenate([[0.0], 0.5 * (vertices[1:] + vertices[:-1]), [float(pixels)]])
    edges = np.arange(pixels + 1.0)
    low = np.maximum(bounds[:-1, None], edges[None, :-1])
    high = np.minimum(bounds[1:, None], edges[None, 1:])
    return np.maximum(high - low, 0.0) / np.diff(bounds)[:, None]


def rms_over(difference: Array, faces: Array) -> float:
    return float(np.sqrt(np.dot(faces, difference**2) / faces.sum()))


def judge_convergence(steps: list[FlowStep], rms: float, settings: FlowSettings) -> tuple[bool, Phrase] | None:
    """Return whether to stop, with a sentence giving the reason; None: go on."""
    state = Phrase(
        "rms difference {percent:.2f} % of the mean after {count} steps", percent=100.0 * rms, count=len(steps)
    )
    if rms <= settings.converged_rms:
        return True, Phrase("The flow converged: {state}.", state=state)
    recent = steps[-_SETTLED_STEPS - 1 :]
    gains = [1.0 - b.rms_percent / a.rms_percent for a, b in pairwise(recent)]
    full = all(step.dt == 1.0 for step in recent[1:])
    shown = len(steps) >= min(_LEAST_STEPS, settings.max_steps)
    if shown and full and len(gains) == _SETTLED_STEPS and max(gains) < _SETTLED_GAIN:
        return True, Phrase("The flow has settled: {state}; what is left is finer than the mesh can move.", state=state)
    if steps and steps[-1].dt < (STUCK_DT if shown else _IMMOVABLE_DT):
        return False, Phrase(
            "The mesh got stuck: {state}; the next triangle to flip allows a step of only {largest_dt:.1e} (a bright "
            "region beside a very dark one). The lens shows the picture with less contrast than asked for.",
            state=state,
            largest_dt=steps[-1].largest_dt,
        )
    if len(steps) >= settings.max_steps:
        return False, Phrase(
            "The flow was stopped at its limit of {max_steps} steps: {state}.",
            max_steps=settings.max_steps,
            state=state,
        )
    return None


def floor_notes(lifted: float, floor: float) -> Iterator[Phrase]:
    """Yield sentences on a picture with parts darker than the floor; nothing if there are none."""
    if lifted > 0.0:
        yield Phrase(
            "{percent:.1f} % of the picture is darker than {floor_percent:g} % of its mean and was lifted to that: "
            "this method cannot make black.",
            percent=100.0 * lifted,
            floor_percent=100.0 * floor,
        )


def face_light(
    screen: TriangleMesh, neighbours: NDArray[np.int32], target: Array, size_mm: tuple[float, float]
) -> Array:
    """Return (n,) integrals of target (ny, nx) over the median dual faces of a mesh that covers [0, w] x [0, h] [mm^2].

    neighbours (m, 3) : the triangle across from each corner, -1 on the rim (optics.paper.mesh_surgery.neighbours_of)
    """
    ny, nx = target.shape
    left = np.zeros_like(target)
    np.cumsum(target[:, :-1], axis=1, out=left[:, 1:])
    scale_x, scale_y = nx / size_mm[0], ny / size_mm[1]
    points = screen.points_mm * np.array([scale_x, scale_y])
    light = _face_light(points, screen.triangles, neighbours, left, np.ascontiguousarray(target))
    return np.asarray(light / (scale_x * scale_y))


@njit(cache=True, nogil=True)
def _along(left: Array, target: Array, x0: float, y0: float, x1: float, y1: float) -> float:
    """Return the integral of F dy on the segment, in pixels, walked pixel by pixel; left[j, i] is F at the pixel's left
    side.
    """
    ny, nx = target.shape
    dx, dy = x1 - x0, y1 - y0
    if dy == 0.0:
        return 0.0
    i, j = min(max(int(np.floor(x0)), 0), nx - 1), min(max(int(np.floor(y0)), 0), ny - 1)
    if dx < 0.0 and x0 == i and i > 0:
        i -= 1
    if dy < 0.0 and y0 == j and j > 0:
        j -= 1
    total, start = 0.0, 0.0
    while True:
        to_x, to_y = np.inf, np.inf
        if (dx > 0.0 and i < nx - 1) or (dx < 0.0 and i > 0):
            to_x = (i + (1 if dx > 0.0 else 0) - x0) / dx
        if (dy > 0.0 and j < ny - 1) or (dy < 0.0 and j > 0):
            to_y = (j + (1 if dy > 0.0 else 0) - y0) / dy
        end = max(start, min(1.0, to_x, to_y))
        middle = x0 + dx * 0.5 * (start + end)
        total += (left[j, i] + target[j, i] * (middle - i)) * dy * (end - start)
        if end >= 1.0:
            return total
        start = end
        if to_x <= to_y:
            i += 1 if dx > 0.0 else -1
        else:
            j += 1 if dy > 0.0 else -1


@njit(cache=True, nogil=True)
def _face_light(
    points: Array, triangles: Triangles, neighbours: NDArray[np.int32], left: Array, target: Array
) -> Array:
    """Return the light per triangle: three sides from edge midpoint to centroid; on the rim, half edges as well."""
    light = np.zeros(points.shape[0])
    for t in range(triangles.shape[0]):
        p, q, r = triangles[t]
        gx = (points[p, 0] + points[q, 0] + points[r, 0]) / 3.0
        gy = (points[p, 1] + points[q, 1] + points[r, 1]) / 3.0
        for k in range(3):
            a, b = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            mx, my = 0.5 * (points[a, 0] + points[b, 0]), 0.5 * (points[a, 1] + points[b, 1])
            inward = _along(left, target, mx, my, gx, gy)
            light[a] += inward
            light[b] -= inward
            if neighbours[t, k] < 0:
                light[a] += _along(left, target, points[a, 0], points[a, 1], mx, my)
                light[b] += _along(left, target, mx, my, points[b, 0], points[b, 1])
    return light
