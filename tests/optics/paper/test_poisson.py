"""P1 finite elements: matrices, order of convergence, the natural boundary."""

import numpy as np
import pytest
from scipy import sparse

from optics.paper.mesh import TriangleMesh
from optics.paper.poisson import NeumannPoisson, divergence_load


def moved_square(n: int) -> TriangleMesh:
    """(n + 1)^2 vertices over the unit square, moved by a smooth map that keeps the frame."""
    x = np.linspace(0.0, 1.0, n + 1)
    mesh = TriangleMesh.build_regular(x, x)
    p = mesh.points_mm
    return mesh.move_to(p + 0.06 * np.sin(2 * np.pi * p) * np.cos(np.pi * p[:, ::-1]))


def cosines(p):
    """A field without normal derivative on the unit square's frame."""
    return np.cos(np.pi * p[:, 0]) * np.cos(2 * np.pi * p[:, 1])


def mass_of(mesh: TriangleMesh) -> sparse.coo_matrix:
    """(n, n) integrals of v_i v_j over the mesh."""
    corners = mesh.triangles
    rows, columns = np.repeat(corners, 3, axis=1), np.tile(corners, 3)
    values = np.outer(mesh.areas() / 12, (np.ones((3, 3)) + np.eye(3)).ravel())
    return sparse.coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())))


def lumped_error(mesh: TriangleMesh, found, exact) -> float:
    faces = mesh.dual_areas()
    error = found - exact
    error = error - np.dot(faces, error) / faces.sum()
    return float(np.sqrt(np.dot(faces, error**2)))


def test_matrices_integrate_what_they_say():
    """v' M v and v' K v of a linear field are its exact integrals; rows of K sum to 0, rows of M to the dual faces."""
    mesh = moved_square(12)
    problem = NeumannPoisson(mesh)
    stiffness, mass = problem.stiffness(mesh), mass_of(mesh)
    plane = mesh.points_mm @ np.array([2.0, 1.0])
    assert plane @ (stiffness @ plane) == pytest.approx(5.0, rel=1e-12)
    assert plane @ (mass @ plane) == pytest.approx(4 / 3 + 1 / 3 + 1.0, rel=1e-12)
    np.testing.assert_allclose(stiffness @ np.ones(plane.size), 0.0, atol=1e-12)
    np.testing.assert_allclose(mass @ np.ones(plane.size), mesh.dual_areas(), rtol=1e-12)


def test_the_neumann_solve_converges_at_second_order_on_a_moved_mesh():
    errors = []
    for n in (16, 32, 64):
        mesh = moved_square(n)
        problem = NeumannPoisson(mesh)
        load = mass_of(mesh) @ (5 * np.pi**2 * cosines(mesh.points_mm))
        solution = problem.solve(mesh, load, tolerance=1e-10)
        assert solution.residual <= 1e-10
        errors.append(lumped_error(mesh, solution.values, cosines(mesh.points_mm)))
    assert 3.4 < errors[0] / errors[1] < 4.6
    assert 3.4 < errors[1] / errors[2] < 4.6


def test_the_weak_divergence_recovers_a_field_whose_normal_part_is_not_zero():
    """h with gradient N, N . n free on the frame: Eq. 7's natural boundary. Linear h is exact, curved second order."""
    mesh = moved_square(16)
    plane = mesh.points_mm @ np.array([0.4, -0.2])
    field = np.broadcast_to([0.4, -0.2], mesh.points_mm.shape)
    found = NeumannPoisson(mesh).solve(mesh, divergence_load(mesh, field), tolerance=1e-12).values
    np.testing.assert_allclose(found, plane - plane.mean(), atol=1e-10)

    errors = []
    for n in (16, 32):
        mesh = moved_square(n)
        x, y = mesh.points_mm.T
        field = np.stack([np.exp(x) * np.sin(y), np.exp(x) * np.cos(y)], axis=1)
        found = NeumannPoisson(mesh).solve(mesh, divergence_load(mesh, field), tolerance=1e-10).values
        errors.append(lumped_error(mesh, found, np.exp(x) * np.sin(y)))
    assert errors[0] / errors[1] > 3.4


def test_the_mean_of_the_load_is_removed_and_the_answer_is_the_same_bits_each_time():
    mesh = moved_square(20)
    load = np.random.default_rng(2).normal(size=mesh.points_mm.shape[0])
    problem = NeumannPoisson(mesh)
    first, again = problem.solve(mesh, load).values, NeumannPoisson(mesh).solve(mesh, load).values
    assert np.array_equal(first, again)
    assert first.mean() == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(problem.solve(mesh, load + 7.0).values, first, atol=1e-4 * np.abs(first).max())
    assert not problem.solve(mesh, np.full_like(load, 3.0)).values.any()


def test_thin_and_sheared_triangles_do_not_stop_the_solver():
    """A mesh squeezed 1:50 and sheared, as the flow leaves it before it sticks: 35 cycles at most for six digits."""
    n = 64
    x = np.linspace(0.0, 1.0, n + 1)
    mesh = TriangleMesh.build_regular(x, x)
    u, v = mesh.points_mm.T
    squeezed, sheared = u - 0.98 * np.sin(2 * np.pi * u) / (2 * np.pi), v - 0.2 * np.sin(np.pi * u) * np.sin(np.pi * v)
    mesh = mesh.move_to(np.stack([squeezed, sheared], axis=1))
    assert 0.0 < mesh.areas().min() < 0.02 * mesh.areas().max()
    solution = NeumannPoisson(mesh).solve(mesh, np.random.default_rng(0).normal(size=(n + 1) ** 2), tolerance=1e-6)
    assert solution.residual <= 1e-6
    assert solution.iterations <= 35
