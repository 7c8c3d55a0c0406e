"""Triangle meshes: areas, dual faces, gradients, the step without a flip, and finding points in a moved grid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optics.paper.mesh import TriangleMesh
from optics.paper.surface import SmoothGridMap


def shaken_mesh(seed: int, *, nx: int = 9, ny: int = 7) -> TriangleMesh:
    """A grid of 8 x 6 mm, its inner vertices moved by up to a quarter cell: no triangle flips."""
    mesh = TriangleMesh.build_regular(np.arange(float(nx)), np.arange(float(ny)))
    shake = np.random.default_rng(seed).uniform(-0.25, 0.25, (ny, nx, 2))
    shake[[0, -1]] = 0.0
    shake[:, [0, -1]] = 0.0
    return mesh.move_to(mesh.points_mm + shake.reshape(-1, 2))


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_triangles_and_dual_faces_tile_the_domain(seed):
    mesh = shaken_mesh(seed)
    assert mesh.areas().min() > 0.0
    assert mesh.areas().sum() == pytest.approx(48.0, rel=1e-13)
    assert mesh.dual_areas().sum() == pytest.approx(48.0, rel=1e-13)


def test_the_median_dual_face_is_what_midpoints_and_centroids_enclose():
    """One inner vertex with six triangles: the polygon of edge midpoints and centroids, by the shoelace formula."""
    mesh = shaken_mesh(3)
    vertex = 3 * 9 + 4
    around = mesh.triangles[(mesh.triangles == vertex).any(axis=1)]
    corners = []
    for triangle in around:
        k = int(np.flatnonzero(triangle == vertex)[0])
        ring = mesh.points_mm[np.roll(triangle, -k)]
        corners += [0.5 * (ring[0] + ring[1]), ring.mean(axis=0)]
    corners = np.array(corners)
    towards = corners - mesh.points_mm[vertex]
    x, y = corners[np.argsort(np.arctan2(towards[:, 1], towards[:, 0]))].T
    shoelace = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    assert mesh.dual_areas()[vertex] == pytest.approx(shoelace, rel=1e-13)


def test_the_gradient_of_a_plane_is_exact_in_triangles_and_at_vertices():
    mesh = shaken_mesh(5)
    plane = mesh.points_mm @ np.array([0.3, -1.7])
    for gradients in (mesh.triangle_gradients(plane), mesh.vertex_gradients(plane, mesh.areas())):
        np.testing.assert_allclose(gradients, np.broadcast_to([0.3, -1.7], gradients.shape), atol=1e-12)


@given(seed=st.integers(0, 10_000), speed=st.floats(1e-6, 1e6))
@settings(max_examples=50, deadline=None)
def test_the_largest_step_is_exactly_the_last_without_a_flip(seed, speed):
    """Just before it all areas are positive; just after, one is not; for velocities of any size."""
    mesh = shaken_mesh(seed)
    velocity = speed * np.random.default_rng(seed + 1).normal(size=mesh.points_mm.shape)
    step = mesh.largest_step(velocity)
    assert mesh.move_to(mesh.points_mm + step * (1 - 1e-9) * velocity).areas().min() > 0.0
    assert mesh.move_to(mesh.points_mm + step * (1 + 1e-6) * velocity).areas().min() < 0.0


def test_a_mesh_that_only_grows_or_drifts_has_no_largest_step():
    mesh = shaken_mesh(1)
    assert mesh.largest_step(mesh.points_mm) == np.inf
    assert mesh.largest_step(np.ones_like(mesh.points_mm)) == np.inf


@pytest.mark.parametrize(
    ("second", "third", "step"),
    [
        ((0, 1), (1, 0), 1.0),  # area 1/2 (1 - t^2): still at first, then falling
        ((2, 0), (0, -0.5), 2.0),  # 1/2 (1 + 2 t)(1 - t / 2): growing at first
        ((-1, 0), (0, -0.25), 1.0),  # 1/2 (1 - t)(1 - t / 4): the smaller of two roots
        ((-1, 0), (0, 0), 1.0),  # linear
        ((0, 1), (-1, 0), np.inf),  # 1/2 (1 + t^2)
    ],
)
def test_the_largest_step_of_one_triangle_is_its_first_root(second, third, step):
    """Corners (0, 0), (1, 0), (0, 1), the first at rest."""
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    mesh = TriangleMesh(points_mm=points, triangles=np.array([[0, 1, 2]], dtype=np.int32))
    assert mesh.largest_step(np.array([(0, 0), second, third], dtype=float)) == pytest.approx(step, rel=1e-14)


def test_a_smooth_map_is_inverted_to_fourth_order():
    """Halving the grid divides the error by about 16; the quads alone would give 4."""
    errors = []
    for n in (17, 33, 65):
        x = np.linspace(0.0, 1.0, n)
        x[1:-1] += 0.2 * x[1]  # spacing is free
        q = np.stack(np.meshgrid(x, x), axis=-1)
        moved = q + 0.05 * np.sin(2 * np.pi * q) * np.cos(np.pi * q[..., ::-1])
        at = np.linspace(0.0, 1.0, 50)
        found = SmoothGridMap(x, x, moved).preimages_mm(at, at)
        image = found + 0.05 * np.sin(2 * np.pi * found) * np.cos(np.pi * found[..., ::-1])
        errors.append(np.abs(image - np.stack(np.meshgrid(at, at), axis=-1)).max())
    assert errors[2] < errors[1] / 8 < errors[0] / 64
