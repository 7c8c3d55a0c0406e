"""The block is closed, faces outward, and holds as much as the integral says."""

import io

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from optics.heightfield import Heightfield
from service.job.errors import ReliefTooDeep, SolidError
from service.job.report.solid import lens_solid, require_floor, stl_bytes
from service.job.spec.optics import ellipse_mm


def wavy(*, nodes: int = 65, width_mm: float = 30.0, height_mm: float = 20.0, skim_mm: float = 0.3) -> Heightfield:
    x, y = np.linspace(0, 1, nodes)[None, :], np.linspace(0, 1, nodes)[:, None]
    z = -skim_mm - 2.0 * (1 + np.sin(5 * x + 1) * np.cos(4 * y))
    return Heightfield.on_aperture(z, width_mm=width_mm, height_mm=height_mm)


def integral_mm3(heightfield: Heightfield, samples: int = 600) -> float:
    """Volume between the spline and Z0, negative, by the midpoint rule."""
    middle = (np.arange(samples) + 0.5) / samples
    x, y = heightfield.width_mm * middle[None, :], heightfield.height_mm * middle[:, None]
    return float(heightfield.spline().heights_mm(x, y).mean() * heightfield.width_mm * heightfield.height_mm)


@pytest.mark.parametrize("margin_mm", [0.0, 4.0])
@pytest.mark.parametrize("vertices", [33, 65])
def test_the_volume_is_the_integral_to_second_order(margin_mm, vertices):
    lens = wavy()
    mesh = lens_solid(lens, thickness_mm=12, margin_mm=margin_mm, max_vertices=vertices)
    box = (lens.width_mm + 2 * margin_mm) * (lens.height_mm + 2 * margin_mm) * 12
    step = 1 / (vertices - 1)
    assert mesh.volume == pytest.approx(box + integral_mm3(lens), abs=2000 * step**2)
    assert mesh.bounds[0] == pytest.approx([-margin_mm, -margin_mm, -12])
    assert mesh.bounds[1][:2] == pytest.approx([lens.width_mm + margin_mm, lens.height_mm + margin_mm])


@pytest.mark.parametrize("margin_mm", [0.0, 2.5])
def test_a_flat_lens_is_exactly_a_box_or_a_box_with_a_pocket(margin_mm):
    flat = Heightfield.on_aperture(np.full((9, 9), -0.5), width_mm=8, height_mm=6)
    mesh = lens_solid(flat, thickness_mm=10, margin_mm=margin_mm)
    assert mesh.volume == pytest.approx((8 + 2 * margin_mm) * (6 + 2 * margin_mm) * 10 - 8 * 6 * 0.5, rel=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.integers(4, 12), st.integers(4, 12), st.floats(0, 5), st.integers(0, 999))
def test_any_lens_closes_even_where_it_touches_the_stock_top(ny, nx, margin_mm, seed):
    z = np.minimum(np.random.default_rng(seed).uniform(-2, 1, (ny, nx)), 0.0)  # a third of it at Z0, rim included
    lens = Heightfield.on_aperture(z, width_mm=10, height_mm=7)
    mesh = lens_solid(lens, thickness_mm=6, margin_mm=margin_mm if margin_mm > 0.01 else 0.0)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)  # so it stays closed when a reader welds them


def test_normals_point_outward_on_every_kind_of_face():
    mesh = lens_solid(wavy(), thickness_mm=12, margin_mm=3, max_vertices=33)
    normals, centres = mesh.face_normals, mesh.triangles_center
    on_lens = (np.abs(centres[:, :2] - [15, 10]) < [14.9, 9.9]).all(axis=1) & (centres[:, 2] > -11.9)
    assert (normals[on_lens, 2] > 0.5).all()
    assert on_lens.sum() > 1000
    back = centres[:, 2] < -11.999
    assert normals[back][:, 2] == pytest.approx(-1.0)
    ring = centres[:, 2] > -1e-9
    assert normals[ring][:, 2] == pytest.approx(1.0)
    left = centres[:, 0] < -2.999
    assert normals[left][:, 0] == pytest.approx(-1.0)


def test_the_binary_stl_reads_back_as_the_same_closed_solid():
    mesh = lens_solid(wavy(), thickness_mm=12, margin_mm=3, max_vertices=65)
    data = stl_bytes(mesh)
    again = trimesh.load_mesh(io.BytesIO(data), file_type="stl")
    assert len(data) == 84 + 50 * len(mesh.faces)
    assert again.is_watertight
    assert again.volume == pytest.approx(mesh.volume, rel=1e-6)


def test_the_grid_is_no_finer_than_asked_and_keeps_the_proportion():
    mesh = lens_solid(wavy(nodes=200), thickness_mm=12, margin_mm=0, max_vertices=31)
    top = mesh.vertices[mesh.vertices[:, 2] > -11.9]
    assert len(np.unique(top[:, 0].round(9))) == 31
    assert len(np.unique(top[:, 1].round(9))) == 21


@given(st.integers(3, 40), st.floats(0.5, 1.0), st.integers(0, 2))
@settings(max_examples=15, deadline=None)
def test_a_flat_lens_cut_out_is_exactly_a_prism(corners, size, margin_mm):
    angles = 2 * np.pi * np.arange(corners) / corners
    outline = np.column_stack([4 + 4 * size * np.cos(angles), 3 + 3 * size * np.sin(angles)])
    area = 4 * 3 * size**2 * corners / 2 * np.sin(2 * np.pi / corners)
    flat = Heightfield.on_aperture(np.full((9, 9), -0.5), width_mm=8, height_mm=6)
    mesh = lens_solid(flat, thickness_mm=10, margin_mm=margin_mm, outline_mm=outline)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(area * 9.5, rel=1e-7)


def test_a_round_lens_keeps_its_surface_and_closes_again_when_read():
    """The volume is that of the same surface, summed over the ellipse by the midpoint rule."""
    lens, axis = wavy(), (np.arange(800) + 0.5) / 800
    outline = ellipse_mm(30.0, 20.0)
    mesh = lens_solid(lens, thickness_mm=12, margin_mm=3, max_vertices=65, outline_mm=outline)
    x, y = 30 * axis[None, :], 20 * axis[:, None]
    inside = ((x - 15) / 15) ** 2 + ((y - 10) / 10) ** 2 < 1
    volume = ((12 + lens.spline().heights_mm(x, y)) * inside).mean() * 600
    assert mesh.volume == pytest.approx(volume, rel=2e-3)  # chords of the outline 1e-4, cells of the sum 1e-3
    again = trimesh.load_mesh(io.BytesIO(stl_bytes(mesh)), file_type="stl")
    assert again.is_watertight
    assert again.volume == pytest.approx(mesh.volume, rel=1e-5)


def test_a_crescent_is_cut_as_it_is():
    """An outline that turns back on itself: no convex hull, no filled notch."""
    flat = Heightfield.on_aperture(np.full((9, 9), -0.5), width_mm=8, height_mm=6)
    notched = [[0, 0], [8, 0], [8, 6], [4, 1], [0, 6]]
    mesh = lens_solid(flat, thickness_mm=10, margin_mm=0, outline_mm=notched)
    assert mesh.volume == pytest.approx((48 - 8 * 5 / 2) * 9.5, rel=1e-7)


def test_a_relief_that_pierces_the_floor_is_refused_with_its_figures():
    lens = wavy()  # its deepest point lies 4.3 mm below the top
    with pytest.raises(
        ReliefTooDeep, match=r"relief of 4\.00 mm.*thickness_mm of 4 .*back.*at least 1 mm.*5\.30"
    ) as caught:
        lens_solid(lens, thickness_mm=4, margin_mm=1)
    assert isinstance(caught.value, SolidError)
    require_floor(lens, thickness_mm=caught.value.needed_mm, min_floor_mm=1.0)
    with pytest.raises(ReliefTooDeep):
        require_floor(lens, thickness_mm=caught.value.needed_mm - 0.01, min_floor_mm=1.0)
