"""Rules that all variants of the paper's flow share: what may be aimed at, what D is, when to stop."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from optics.errors import TargetError
from optics.paper.face_light import face_light
from optics.paper.flow_record import FlowSettings, FlowStep, pixel_vertices
from optics.paper.mesh import MeshPair
from optics.paper.mesh_surgery import Neighbours
from optics.spline import Array
from phrases.phrase import Phrase


def project_to_frame(velocity: Array, shape: tuple[int, int]) -> Array:
    """Return (n, 2) velocities with no component across the frame; corners stand still."""
    field = velocity.reshape(*shape, 2).copy()
    field[:, 0, 0] = field[:, -1, 0] = 0.0
    field[0, :, 1] = field[-1, :, 1] = 0.0
    return field.reshape(-1, 2)


def excess_on_faces(pair: MeshPair, across: Neighbours, target: Array, size_mm: tuple[float, float]) -> Array:
    """Return (n,) light each face of a remeshed lens has beyond what its face on the screen should get [mm^2]: D x
    area.
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
    """Return whether to stop, and the sentence why; None goes on."""
    state = Phrase(
        "rms difference {percent:.2f} % of the mean after {count} steps", percent=100.0 * rms, count=len(steps)
    )
    if rms <= settings.converged_rms:
        return True, Phrase("The flow converged: {state}.", state=state)
    recent = steps[-settings.settled_steps - 1 :]
    gains = [1.0 - b.rms_percent / a.rms_percent for a, b in pairwise(recent)]
    full = all(step.dt == 1.0 for step in recent[1:])
    shown = len(steps) >= min(settings.least_steps, settings.max_steps)
    if shown and full and len(gains) == settings.settled_steps and max(gains) < settings.settled_gain:
        return True, Phrase("The flow has settled: {state}; what is left is finer than the mesh can move.", state=state)
    if steps and steps[-1].dt < (settings.stuck_dt if shown else settings.immovable_dt):
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
    """Yield what was done to a picture darker than the floor; nothing where none of it is."""
    if lifted > 0.0:
        yield Phrase(
            "{percent:.1f} % of the picture is darker than {floor_percent:g} % of its mean and was lifted to that: "
            "this method cannot make black.",
            percent=100.0 * lifted,
            floor_percent=100.0 * floor,
        )
