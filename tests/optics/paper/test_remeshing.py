"""Remeshing: the map stays one-to-one and the same map, light is exact, nothing depends on luck."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optics.paper.flow import FlowSettings, solve_paper_map
from optics.paper.flow_rules import face_light
from optics.paper.mesh import MeshPair, TriangleMesh
from optics.paper.mesh_surgery import flip, neighbours_of
from optics.paper.remesh import without_short_lived


def shaken(seed: int, *, nx: int = 13, ny: int = 10, by: float = 0.25) -> TriangleMesh:
    """A grid of 12 x 9 mm whose inner vertices are moved by up to `by` cells."""
    mesh = TriangleMesh.build_regular(np.arange(float(nx)), np.arange(float(ny)))
    shake = np.random.default_rng(seed).uniform(-by, by, (ny, nx, 2))
    shake[[0, -1]] = 0.0
    shake[:, [0, -1]] = 0.0
    return mesh.move_to(mesh.points_mm + shake.reshape(-1, 2))


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_the_faces_share_the_pictures_light_exactly(seed):
    """Any mesh, any picture: sums to the picture's light; an even picture gives each face its area."""
    mesh = shaken(seed)
    picture = np.random.default_rng(seed).uniform(0.0, 3.0, (7, 11))
    across = neighbours_of(mesh.triangles)
    light = face_light(mesh, across, picture, (12.0, 9.0))
    assert light.sum() == pytest.approx(picture.mean() * 108.0, rel=1e-12)
    even = face_light(mesh, across, np.ones((7, 11)), (12.0, 9.0))
    np.testing.assert_allclose(even, mesh.dual_areas(), rtol=1e-12)


def test_the_light_of_a_face_is_that_of_its_pixels():
    """On the lattice of pixel corners with both diagonals' mean the face of a vertex holds what a fine sum says."""
    mesh = shaken(4)
    picture = np.random.default_rng(1).uniform(0.0, 3.0, (9, 12))
    light = face_light(mesh, neighbours_of(mesh.triangles), picture, (12.0, 9.0))
    fine = np.zeros(mesh.points_mm.shape[0])
    k = 60  # each triangle in k^2 equal parts, given to the corner with the greatest weight: who owns it, by medians
    i, j = (a.ravel() for a in np.meshgrid(np.arange(k), np.arange(k)))
    up = np.stack([i + 1 / 3, j + 1 / 3])[:, i + j < k]
    down = np.stack([i + 2 / 3, j + 2 / 3])[:, i + j < k - 1]
    u, v = np.concatenate([up, down], axis=1) / k
    weights = np.stack([1 - u - v, u, v], axis=1)
    for triangle, area in zip(mesh.triangles, mesh.areas(), strict=True):
        x, y = (weights @ mesh.points_mm[triangle]).T
        part = picture[y.astype(int).clip(max=8), x.astype(int).clip(max=11)] * area / weights.shape[0]
        np.add.at(fine, triangle[weights.argmax(axis=1)], part)
    np.testing.assert_allclose(light, fine, atol=0.02 * light.mean())  # the pieces are k^-2 of a triangle


def test_a_flip_keeps_the_neighbours_right():
    mesh = shaken(2)
    triangles, across = mesh.triangles.copy(), neighbours_of(mesh.triangles)
    for t in (30, 77, 121):
        flip(triangles, across, t, int(np.flatnonzero(across[t] >= 0)[0]))
    np.testing.assert_array_equal(across, neighbours_of(triangles))


@pytest.mark.thorough
@given(seed=st.integers(0, 10_000), wanted=st.floats(0.02, 2.0))
@settings(max_examples=8, deadline=None)
def test_remeshing_keeps_a_one_to_one_map_and_lengthens_lives(seed, wanted):
    """Whatever the velocities: both planes stay tiled by counter-clockwise triangles, the frame keeps its corners, and
    the first flip comes no sooner than before."""
    screen, lens = shaken(seed), shaken(seed + 1)
    velocity = np.random.default_rng(seed).normal(size=lens.points_mm.shape)
    on_frame = np.isin(screen.points_mm, [0.0]) | (screen.points_mm == [12.0, 9.0])
    velocity[on_frame] = 0.0
    pair = MeshPair(screen=screen, lens=lens)
    made = without_short_lived(pair, velocity, wanted=wanted, pixel_mm=(1.0, 1.0), rng=np.random.default_rng(seed))
    for mesh in (made.pair.screen, made.pair.lens):
        assert mesh.areas().min() > 0.0
        assert mesh.areas().sum() == pytest.approx(108.0, rel=1e-12)
    assert {(0.0, 0.0), (12.0, 0.0), (0.0, 9.0), (12.0, 9.0)} <= {tuple(p) for p in made.pair.lens.points_mm}
    assert made.inserted <= made.removed + 1
    assert made.pair.lens.points_mm.shape[0] == 130 - made.removed + made.inserted
    assert made.pair.lens.largest_step(made.velocity_mm) >= lens.largest_step(velocity) * (1 - 1e-9)


def test_where_nothing_flips_soon_nothing_is_done():
    mesh = shaken(5)
    made = without_short_lived(
        MeshPair(screen=mesh, lens=mesh),
        0.01 * mesh.points_mm,
        wanted=0.2,
        pixel_mm=(1, 1),
        rng=np.random.default_rng(0),
    )
    assert (made.removed, made.inserted) == (0, 0)
    np.testing.assert_array_equal(made.pair.triangles, mesh.triangles)


def spot_on_dark(n: int = 40):
    y, x = np.mgrid[:n, :n] / n
    picture = np.where((np.hypot(x - 0.4, y - 0.55) < 0.2) | (np.abs(y - 0.15) < 0.04), 1.0, 0.02)
    return picture / picture.mean()


@pytest.mark.thorough
@pytest.mark.parametrize("remeshing", ["simple", "clean"])
def test_a_remeshed_flow_goes_on_where_the_plain_one_is_stuck(remeshing):
    picture = spot_on_dark()
    flows = {
        way: solve_paper_map(picture, width_mm=40.0, height_mm=40.0, settings=FlowSettings(remeshing=way))
        for way in ("none", remeshing)
    }
    remeshed = flows[remeshing]
    assert min(step.rms_percent for step in remeshed.steps) < 0.6 * flows["none"].steps[-1].rms_percent
    for mesh in (remeshed.pair.lens, remeshed.pair.screen):
        assert mesh.areas().min() > 0.0
        assert mesh.areas().sum() == pytest.approx(1600.0, rel=1e-12)
    assert sum(step.removed > 0 or step.remeshed for step in remeshed.steps) > 2
    assert remeshed.lens_mm.shape == (40, 40, 2) and np.isfinite(remeshed.lens_mm).all()
    np.testing.assert_allclose(remeshed.lens_mm[:, 0, 0], 0.0, atol=1e-9)


@pytest.mark.parametrize("remeshing", ["simple", "clean"])
def test_remeshing_gives_the_same_bytes_each_time(remeshing):
    picture = spot_on_dark(24)
    first, second = (
        solve_paper_map(picture, width_mm=24.0, height_mm=24.0, settings=FlowSettings(remeshing=remeshing))
        for _ in range(2)
    )
    assert first.pair.lens.points_mm.tobytes() == second.pair.lens.points_mm.tobytes()
    assert first.pair.screen.points_mm.tobytes() == second.pair.screen.points_mm.tobytes()


def test_clean_remeshing_ends_on_the_lenss_own_even_grid():
    flow = solve_paper_map(
        spot_on_dark(), width_mm=40.0, height_mm=40.0, settings=FlowSettings(remeshing="clean"), lens_cells=(60, 50)
    )
    rest = TriangleMesh.build_regular(np.linspace(0, 40, 61), np.linspace(0, 40, 51))
    np.testing.assert_array_equal(flow.pair.lens.points_mm, rest.points_mm)
