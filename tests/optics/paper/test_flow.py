"""The transport flow: light is conserved, no triangle flips, and D falls."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from optics.errors import TargetError
from optics.paper.flow import FlowSettings, pixel_vertices, solve_paper_map
from optics.paper.flow_rules import STUCK_DT
from optics.paper.mesh import TriangleMesh


def soft_picture(ny: int = 40, nx: int = 40, contrast: float = 0.7):
    """Smooth, without any symmetry, mean 1."""
    y, x = np.mgrid[:ny, :nx] / max(ny, nx)
    picture = 1 + contrast * np.sin(5 * x + 2 * y + 0.3) * np.cos(4 * y - x)
    return picture / picture.mean()


def mesh_of(flow, lens_mm) -> TriangleMesh:
    return TriangleMesh.build_regular(flow.x_mm, flow.y_mm).move_to(lens_mm.reshape(-1, 2))


def test_a_uniform_picture_needs_no_step():
    flow = solve_paper_map(np.ones((20, 30)), width_mm=30.0, height_mm=20.0)
    assert flow.converged and flow.steps == ()
    np.testing.assert_array_equal(flow.lens_mm, np.stack(np.meshgrid(flow.x_mm, flow.y_mm), axis=-1))


def test_vertices_stand_on_pixel_centres_and_the_outermost_on_the_frame():
    np.testing.assert_allclose(pixel_vertices(5, 10.0), [0.0, 3.0, 5.0, 7.0, 10.0])


@given(picture=arrays.arrays(np.float64, (9, 12), elements=st.floats(0.0, 1.0)))
@settings(max_examples=15, deadline=None)
def test_flux_is_exact_and_no_triangle_flips_whatever_the_picture(picture):
    """Hard random pictures, black included: the light asked for is the light there is, and the map stays one-to-one."""
    picture[4, 5] = 1.0
    flow = solve_paper_map(picture, width_mm=12.0, height_mm=9.0)
    rest, mesh = mesh_of(flow, np.stack(np.meshgrid(flow.x_mm, flow.y_mm), axis=-1)), mesh_of(flow, flow.lens_mm)
    assert np.dot(flow.target.ravel(), rest.dual_areas()) == pytest.approx(108.0, rel=1e-12)
    assert mesh.dual_areas().sum() == pytest.approx(108.0, rel=1e-12)
    assert all(step.dt <= 0.5 * step.largest_dt and step.dt <= 1.0 for step in flow.steps)
    assert mesh.areas().min() > 0.0
    for side, wanted in ((flow.lens_mm[:, 0, 0], 0), (flow.lens_mm[:, -1, 0], 12), (flow.lens_mm[-1, :, 1], 9)):
        assert np.all(side == wanted)


def test_a_converged_cell_holds_its_targets_share():
    picture = soft_picture()
    flow = solve_paper_map(picture, width_mm=40.0, height_mm=40.0)
    assert flow.converged
    assert flow.steps[-1].rms_percent < 1.0
    assert all(after.rms_percent < before.rms_percent for before, after in pairwise(flow.steps))
    # Away from the frame a face is a pixel, so what it collects is the picture.
    collected = mesh_of(flow, flow.lens_mm).dual_areas().reshape(40, 40)
    np.testing.assert_allclose(collected[2:-2, 2:-2], picture[2:-2, 2:-2], atol=0.02)


def test_bright_places_are_lit_from_wider_ones():
    """The sign: a bright spot collects from beyond its own outline, so vertices around it move away from it."""
    y, x = np.mgrid[:33, :33] - 16.0
    picture = 0.5 + 2 * np.exp(-(x**2 + y**2) / 20)
    flow = solve_paper_map(picture, width_mm=33.0, height_mm=33.0)
    moved = flow.lens_mm - np.stack(np.meshgrid(flow.x_mm, flow.y_mm), axis=-1)
    assert moved[16, 22, 0] > 1.0 and moved[22, 16, 1] > 1.0


def test_the_first_step_adds_no_divergence_free_component():
    """Its velocity is a mean of gradients: orthogonal to every curl that vanishes on the frame, to second order."""
    overlaps = []
    for n in (24, 48):
        flow = solve_paper_map(soft_picture(n, n), width_mm=1.0, height_mm=1.0, settings=FlowSettings(max_steps=1))
        q = np.stack(np.meshgrid(flow.x_mm, flow.y_mm), axis=-1)
        moved = (flow.lens_mm - q).reshape(-1, 2)
        x, y = q.reshape(-1, 2).T
        stream_x = np.pi * np.cos(np.pi * x) * np.sin(2 * np.pi * y)
        stream_y = 2 * np.pi * np.sin(np.pi * x) * np.cos(2 * np.pi * y)
        curl = np.stack([stream_y, -stream_x], axis=1)
        faces = mesh_of(flow, q).dual_areas()
        overlap = np.dot(faces, (moved * curl).sum(axis=1))
        overlaps.append(abs(overlap) / np.sqrt(np.dot(faces, (moved**2).sum(1)) * np.dot(faces, (curl**2).sum(1))))
    assert overlaps[1] < overlaps[0] < 5e-3
    assert overlaps[1] < 2e-3


def test_half_a_turn_of_the_picture_turns_the_map():
    """The triangulation is its own half turn, so only the solver's tolerance is between the two."""
    picture = soft_picture(24, 30)
    flow = solve_paper_map(picture, width_mm=30.0, height_mm=24.0, settings=FlowSettings(solver_tolerance=1e-8))
    turned = solve_paper_map(
        picture[::-1, ::-1], width_mm=30.0, height_mm=24.0, settings=FlowSettings(solver_tolerance=1e-8)
    )
    np.testing.assert_allclose(np.array([30.0, 24.0]) - turned.lens_mm[::-1, ::-1], flow.lens_mm, atol=1e-3)


def test_a_quarter_turn_turns_the_map_to_discretisation_error():
    """The diagonals do not turn with the picture: a small share of a cell is left, and less on a finer grid."""
    errors = []
    for n in (20, 40):
        picture = soft_picture(n, n)
        flow = solve_paper_map(picture, width_mm=1.0, height_mm=1.0)
        turned = solve_paper_map(np.rot90(picture), width_mm=1.0, height_mm=1.0)
        # rot90 sends (row j, column i) to (row n - 1 - i, column j): x' = y, y' = 1 - x
        back = np.rot90(turned.lens_mm, -1)
        errors.append(np.abs(np.stack([1 - back[..., 1], back[..., 0]], axis=-1) - flow.lens_mm).max())
    assert errors[0] < 0.3 / 20
    assert errors[1] < 0.7 * errors[0]


def test_a_stuck_mesh_says_so_and_keeps_a_one_to_one_map():
    picture = np.zeros((48, 48))
    picture[14:30, 20:36] = 1.0
    picture[5:9, 5:40] = 1.0
    flow = solve_paper_map(picture, width_mm=48.0, height_mm=48.0)
    assert not flow.converged
    assert "stuck" in flow.message and "cannot make black" in flow.message
    assert flow.steps[-1].rms_percent < 0.95 * 100 * np.std(flow.target)
    # the figure's last step is reported all the same; the lens is that of the first step that moved nothing
    assert [s.step for s in flow.snapshots] == [1, 3, 5, 7, 25]
    tiny = [step.step for step in flow.steps if step.dt < STUCK_DT]
    assert flow.lens_step == tiny[0] < 25
    assert mesh_of(flow, flow.lens_mm).areas().min() > 0.0


def test_snapshots_are_those_of_the_papers_figure_and_the_last():
    flow = solve_paper_map(
        soft_picture(), width_mm=40.0, height_mm=40.0, settings=FlowSettings(max_steps=9, converged_rms=0)
    )
    assert [s.step for s in flow.snapshots][:4] == [1, 3, 5, 7]
    assert flow.snapshots[-1].step == flow.steps[-1].step
    for snapshot in flow.snapshots:
        assert 100 * np.abs(snapshot.difference).max() == pytest.approx(flow.steps[snapshot.step - 1].max_percent)
    screen, lens = flow.corners_mm()
    assert screen.shape == lens.shape == (41, 41, 2)
    assert np.all(lens[:, 0, 0] == 0.0) and np.all(lens[0, :, 1] == 0.0)


@pytest.mark.parametrize("picture", [np.ones((3, 9)), np.zeros((8, 8)), np.full((8, 8), np.nan), -np.ones((8, 8))])
def test_what_cannot_be_aimed_at_is_an_error(picture):
    with pytest.raises(TargetError):
        solve_paper_map(picture, width_mm=1.0, height_mm=1.0)
