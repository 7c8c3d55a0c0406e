"""Input and output of the paper's flow: settings, steps, snapshots, the mapping."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from optics.paper.mesh import MeshPair
from optics.spline import Array
from phrases.phrase import Phrase

Progress = Callable[[str, float], None]
Remeshing = Literal["none", "simple", "clean"]

KEPT_STEPS = (1, 3, 5, 7, 25)  # of the paper's Fig. 6; and the last


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowSettings:
    """When the flow stops, how little light it aims at, and what becomes of a mesh that gets stuck.

    remeshing : "none", as in the paper's section 4; "simple", its section 5 (see optics.paper.flow_darts); "clean", its
                future work (see optics.paper.flow_even)
    """

    max_steps: int = 60
    converged_rms: float = 0.0025  # rms of D over the mean intensity
    settled_gain: float = 0.02  # converged, too, once full steps lower the rms by less than this share ...
    settled_steps: int = 3  # ... so many times running: what is left is finer than the mesh can move
    stuck_dt: float = 5e-3  # a step this small moves nothing worth while: stuck ...
    least_steps: int = 25  # ... yet the flow goes on so far, for the paper's figure ...
    immovable_dt: float = 1e-9  # ... unless the mesh cannot move at all
    floor: float = 0.01  # least target, as a share of the mean
    solver_tolerance: float = 1e-4
    remeshing: Remeshing = "none"
    short_life: float = 0.2  # "simple": a triangle that flips within this time is cut out
    seed: int = 20140301  # of the darts


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
    removed: int = 0  # vertices taken out by remeshing before the step
    inserted: int = 0
    remeshed: bool = False  # "clean": put back on an even grid after the step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlowSnapshot:
    """What Fig. 6 shows of one step: D (ny, nx), mean intensity 1, and the moved vertices (ny, nx, 2)."""

    step: int
    difference: Array
    lens_mm: Array

    def isoparametric_lines(self, count: int = 32) -> Iterator[Array]:
        """Yield about `count` polylines (k, 2) each way: images of lines of constant screen x and y, frame included."""
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
    `pair` is the mesh in both planes: that of x_mm, y_mm and lens_mm without remeshing, any other with it.
    """

    x_mm: Array
    y_mm: Array
    lens_mm: Array
    lens_step: int  # after which the mesh lay like this
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
