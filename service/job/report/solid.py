"""The lens as a watertight solid block: for looking at, for quoting, for CAD. The programs never come from it.

The block holds a flat back at -thickness, four sides, the lens surface on its own coarser grid, and, where there is a
margin, a flat ring at Z0 with an upright wall down to the rim of the lens. A lens with an outline of its own is shown
as cut out: its sides are upright and follow the outline, without a margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import manifold3d
import numpy as np
from numpy.typing import NDArray

from optics.heightfield import Array, Heightfield
from phrases.phrase import Phrase, join
from service.job.errors import ReliefTooDeep, SolidError

Indices = NDArray[np.int64]

_OVERLAP_MM = 1.0  # of the cutting column beyond the block, so that no two faces coincide


def require_floor(heightfield: Heightfield, *, thickness_mm: float, min_floor_mm: float = 1.0) -> None:
    """Raise ReliefTooDeep unless min_floor_mm of stock is left under the deepest vertex."""
    deepest_mm = max(0.0, -float(heightfield.z_mm.min()))
    if thickness_mm - deepest_mm < min_floor_mm:
        raise ReliefTooDeep(
            deepest_mm=deepest_mm,
            relief_mm=heightfield.relief_mm,
            thickness_mm=thickness_mm,
            min_floor_mm=min_floor_mm,
        )


def lens_solid(
    heightfield: Heightfield,
    *,
    thickness_mm: float,
    margin_mm: float,
    min_floor_mm: float = 1.0,
    max_vertices: int = 257,
    outline_mm: Sequence[Sequence[float]] | None = None,
) -> Any:
    """Return the block as a trimesh.Trimesh, normals outward, at most max_vertices along the longer side of the lens.

    outline_mm : corners in the aperture, counter-clockwise, that the block is cut along; None: it stays a box
    Raises ReliefTooDeep if the floor gets thinner than min_floor_mm, SolidError if no closed solid results.
    """
    require_floor(heightfield, thickness_mm=thickness_mm, min_floor_mm=min_floor_mm)
    x_mm, y_mm, z_mm = _lens_grid(heightfield, max_vertices)
    vertices, faces = _block(
        x_mm, y_mm, z_mm, thickness_mm=thickness_mm, margin_mm=margin_mm if outline_mm is None else 0.0
    )
    mesh = _mesh(vertices, faces)
    solid = _require_closed(mesh)
    return mesh if outline_mm is None else _cut_out(solid, outline_mm, thickness_mm)


def stl_bytes(mesh: Any) -> bytes:
    """Return binary STL in millimetres."""
    return bytes(mesh.export(file_type="stl"))


def _cut_out(solid: manifold3d.Manifold, outline_mm: Sequence[Sequence[float]], thickness_mm: float) -> Any:
    """Return the part of the block above the outline."""
    flat = manifold3d.CrossSection([[(x, y) for x, y in outline_mm]])
    column = flat.extrude(thickness_mm + 2 * _OVERLAP_MM).translate((0, 0, -thickness_mm - _OVERLAP_MM))
    cut = (solid ^ column).to_mesh64()
    mesh = _mesh(np.array(cut.vert_properties)[:, :3], np.array(cut.tri_verts, np.int64))
    _require_closed(mesh)
    return mesh


def _mesh(vertices: Array, faces: Indices) -> Any:
    import trimesh  # slow to import, and not needed to check whether a lens fits

    return trimesh.Trimesh(vertices=vertices, faces=faces, process=False)


def _lens_grid(heightfield: Heightfield, max_vertices: int) -> tuple[Array, Array, Array]:
    """Return axes and spline heights of a grid from rim to rim, no finer than the heightfield, nowhere above Z0."""
    longer = max(heightfield.width_mm, heightfield.height_mm)
    nx, ny = (
        max(2, min(nodes, round((max_vertices - 1) * side / longer) + 1))
        for nodes, side in (
            (heightfield.x_mm.size, heightfield.width_mm),
            (heightfield.y_mm.size, heightfield.height_mm),
        )
    )
    x_mm = np.linspace(heightfield.x_mm[0], heightfield.x_mm[-1], nx)
    y_mm = np.linspace(heightfield.y_mm[0], heightfield.y_mm[-1], ny)
    return x_mm, y_mm, np.minimum(heightfield.spline().heights_mm(x_mm[None, :], y_mm[:, None]), 0.0)


def _block(x_mm: Array, y_mm: Array, z_mm: Array, *, thickness_mm: float, margin_mm: float) -> tuple[Array, Indices]:
    """Return vertices (n, 3) and outward triangles (m, 3) of the whole block.

    The rim of the lens is a closed loop of vertices. Copies of that loop, level after level, make the wall up to Z0,
    the flat ring outward, and the sides down to the back, which is a fan around one centre vertex.
    """
    ny, nx = z_mm.shape
    grid = np.stack([*np.broadcast_arrays(x_mm[None, :], y_mm[:, None]), z_mm], axis=-1).reshape(-1, 3)
    index = np.arange(ny * nx).reshape(ny, nx)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    centre_mm = np.array([(x_mm[0] + x_mm[-1]) / 2, (y_mm[0] + y_mm[-1]) / 2])
    loops = []
    if margin_mm > 0:
        loops = [_at_height(grid[rim], 0.0), _grow(_at_height(grid[rim], 0.0), centre_mm, margin_mm)]
    outer = loops[-1] if loops else grid[rim]
    loops += [_at_height(outer, -thickness_mm)]
    starts = grid.shape[0] + rim.size * np.arange(len(loops))
    rings = [rim, *(np.arange(start, start + rim.size) for start in starts)]
    if margin_mm > 0:  # where the lens touches Z0 the wall has no height, and its two vertices coincide
        rings[1] = np.where(grid[rim, 2] >= 0.0, rim, rings[1])
    back = grid.shape[0] + rim.size * len(loops)
    vertices = np.concatenate([grid, *loops, [[*centre_mm, -thickness_mm]]])
    faces = [
        _quads(index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]),
        *(_band(above, below) for above, below in pairwise(rings)),
        np.stack([np.roll(rings[-1], -1), rings[-1], np.full(rim.size, back)], axis=1),
    ]
    return _without_unused(vertices, _proper(np.concatenate(faces)))


def _at_height(loop: Array, z_mm: float) -> Array:
    return np.column_stack([loop[:, :2], np.full(len(loop), z_mm)])


def _grow(loop: Array, centre_mm: Array, margin_mm: float) -> Array:
    """Return the rectangular loop with margin_mm added on each side; vertices keep their share of each side."""
    half_mm = np.abs(loop[:, :2] - centre_mm).max(axis=0)
    return np.column_stack([centre_mm + (loop[:, :2] - centre_mm) * (1 + margin_mm / half_mm), loop[:, 2]])


def _band(inner: Indices, outer: Indices) -> Indices:
    """Return triangles between two loops that both run counter-clockwise seen from above; `inner` comes first on the
    skin.
    """
    return _quads(inner, outer, np.roll(outer, -1), np.roll(inner, -1))


def _quads(a: Indices, b: Indices, c: Indices, d: Indices) -> Indices:
    """Return two triangles for each quad a-b-c-d, counter-clockwise seen from outside."""
    first = np.stack([a, b, c], axis=-1).reshape(-1, 3)
    second = np.stack([a, c, d], axis=-1).reshape(-1, 3)
    return np.concatenate([first, second])


def _proper(faces: Indices) -> Indices:
    """Return the triangles without those that have collapsed to an edge."""
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def _without_unused(vertices: Array, faces: Indices) -> tuple[Array, Indices]:
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(faces.shape)


def _require_closed(mesh: Any) -> manifold3d.Manifold:
    """Make the solid that the mesh bounds; two libraries must agree that it does."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(vert_properties=np.asarray(mesh.vertices), tri_verts=np.asarray(mesh.faces, dtype=np.uint64))
    )
    status = solid.status()
    faults = [
        fault
        for fault, found in (
            (Phrase("not watertight"), not mesh.is_watertight),
            (Phrase("faces wound both ways"), not mesh.is_winding_consistent),
            (Phrase("inside out"), mesh.volume <= 0),
            (Phrase("manifold3d says {status}", status=status.name), status != manifold3d.Error.NoError),
        )
        if found
    ]
    if faults:
        raise SolidError(Phrase("the lens does not close to a solid block: {faults}", faults=join(", ", faults)))
    return solid
