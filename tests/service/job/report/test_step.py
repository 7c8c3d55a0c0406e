"""lens.step, read by a parser of the test's own: its surface is the spline, its net closed, its numbers in the format.

`tests/trials/cad.py` reads the same files with OpenCascade.
"""

from __future__ import annotations

import io
import re
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import bisplev

from optics.heightfield import Heightfield
from service.job.report import step
from service.job.report.step import step_file, step_pieces
from tests.service.job.report.sheet import render_report

ENTITY = re.compile(r"#(\d+)=([A-Z0-9_]*)(\(.*?\));\n", re.DOTALL)
REAL = r"-?\d+\.\d*(?:E[+-]?\d+)?"
_SPEC = {
    "image": {"pixels": 500},
    "optics": {"width_mm": 100.0, "height_mm": 80.0, "throw_mm": 200.0, "refractive_index": 1.5},
    "stock": {"thickness_mm": 40.0, "margin_mm": 5.0, "skim_mm": 0.1},
}


def random_lens(nx: int, ny: int, seed: int) -> Heightfield:
    z = -np.random.default_rng(seed).uniform(0.1, 3.0, (ny, nx))
    return Heightfield.on_aperture(z, width_mm=33.3, height_mm=7.77)


def read(text: str) -> dict[str, list[tuple[int, str]]]:
    """(number, arguments) of all entities by kind; every reference must be to one of them."""
    found: dict[str, list[tuple[int, str]]] = {}
    numbers = set()
    for number, kind, arguments in ENTITY.findall(text.partition("DATA;\n")[2]):
        found.setdefault(kind, []).append((int(number), arguments))
        numbers.add(int(number))
    assert numbers == set(range(1, len(numbers) + 1))
    assert {int(one) for one in re.findall(r"#(\d+)", text)} == numbers
    return found


def points_of(found):
    return {
        number: [float(value) for value in re.findall(REAL, arguments)]
        for number, arguments in found["CARTESIAN_POINT"]
    }


def surface_of(found, nx: int, ny: int):
    """Knots of x and y, and the net (nx, ny, 3)."""
    ((_, arguments),) = found["B_SPLINE_SURFACE_WITH_KNOTS"]
    points = points_of(found)
    net = np.array([points[int(one)] for one in re.findall(r"#(\d+)", arguments)]).reshape(nx, ny, 3)
    lists = [one.split(",") for one in re.findall(r"\(([\d.,E+-]+)\)", arguments)]
    many_x, many_y, knots_x, knots_y = ([float(value) for value in one] for one in lists[-4:])
    return np.repeat(knots_x, np.array(many_x, int)), np.repeat(knots_y, np.array(many_y, int)), net


@settings(max_examples=20, deadline=None)
@given(st.integers(4, 30), st.integers(4, 30), st.integers(0, 99))
def test_the_surface_is_the_spline_within_a_nanometre_everywhere(nx, ny, seed):
    lens = random_lens(nx, ny, seed)
    found = read(b"".join(step_pieces(lens, thickness_mm=12.0)).decode())
    t_x, t_y, net = surface_of(found, nx, ny)
    u, v = np.linspace(0, 33.3, 53), np.linspace(0, 7.77, 47)
    x, y, z = (bisplev(u, v, (t_x, t_y, net[..., d].ravel(), 3, 3)) for d in range(3))
    assert np.abs(z - lens.spline().heights_mm(x, y)).max() < 1e-6


@pytest.mark.parametrize(
    "outline", ["rectangle", "ellipse", [[1.0, 1.0], [30.0, 0.5], [33.3, 7.0], [15.0, 3.0], [2.0, 7.77]]]
)
def test_every_edge_bounds_two_faces_once_in_each_direction_and_ends_where_its_curve_does(outline):
    found = read(b"".join(step_pieces(random_lens(40, 12, 1), thickness_mm=12.0, outline=outline)).decode())
    uses = [re.findall(r"#(\d+),\.([TF])\.", arguments)[0] for _, arguments in found["ORIENTED_EDGE"]]
    edges = {str(number) for number, _ in found["EDGE_CURVE"]}
    assert sorted(uses) == sorted((edge, way) for edge in edges for way in "TF")
    points = points_of(found)
    vertices = {number: points[int(arguments[5:-1])] for number, arguments in found["VERTEX_POINT"]}
    curves = {number: re.findall(r"#(\d+)", arguments) for number, arguments in found["B_SPLINE_CURVE_WITH_KNOTS"]}
    sides = 0
    for _, arguments in found["EDGE_CURVE"]:
        start, end, curve = (int(one) for one in re.findall(r"#(\d+)", arguments))
        if curve in curves:
            sides += 1
            assert [points[int(curves[curve][0])], points[int(curves[curve][-1])]] == [vertices[start], vertices[end]]
    assert len(found["ADVANCED_FACE"]) == sides + 2


def test_the_edge_of_a_round_lens_lies_on_the_surface_and_on_the_true_ellipse():
    x, y = np.linspace(0, 33.3, 100), np.linspace(0, 7.77, 40)
    lens = Heightfield.on_aperture(np.sin(x[None, :]) * np.cos(y[:, None]) - 1.5, width_mm=33.3, height_mm=7.77)
    for side in step._sides_of(lens, "ellipse"):
        curve = side.top(lens)
        x, y, z = curve(np.linspace(0, np.pi, 5000)).T
        assert np.abs(np.hypot((x - 16.65) / 16.65, (y - 3.885) / 3.885) - 1).max() < 1e-9
        assert np.abs(z - lens.spline().heights_mm(x, y)).max() < 1e-5


def test_units_are_millimetres_and_every_real_number_has_its_point():
    text = b"".join(step_pieces(random_lens(8, 9, 3), thickness_mm=1e-5 + 12)).decode()
    assert "SI_UNIT(.MILLI.,.METRE.)" in text
    for arguments in re.findall(r"(?:CARTESIAN_POINT|DIRECTION)\('',\((.*?)\)\)", text):
        for value in arguments.split(","):
            assert re.fullmatch(REAL, value), value
    assert max(map(len, re.findall(r"(?:CARTESIAN_POINT|DIRECTION)\('',\(.*?\)\)", text))) < 80


def test_a_file_that_would_be_too_large_is_packed_with_the_same_text_inside(monkeypatch):
    lens = random_lens(8, 9, 3)
    plain, text = step_file(step_pieces(lens, thickness_mm=12.0))
    monkeypatch.setattr(step, "MOST_BYTES", len(text) - 1)
    packed, data = step_file(step_pieces(lens, thickness_mm=12.0))
    assert (plain, packed) == ("lens.step", "lens.stpZ")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.namelist() == ["lens.step"]
        assert archive.read("lens.step") == text


def test_the_sheet_tells_another_shop_its_tolerance_its_finish_and_the_wall():
    """Half of a pixel of 0.2 mm on a wall at 200 mm, n = 1.5: 1 mrad."""
    assert "For another shop" not in render_report({}, spec=_SPEC, files=["lens.stl"])
    page = render_report({"optics": {"min_radius_mm": 1.5}}, spec=_SPEC, files=["lens.step"])
    assert "within 1 µm per mm (1 mrad)" in page
    assert "waves of 1 mm may be 0.32 µm" in page
    assert "at most 18 nm" in page
    assert "at most R 1.5" in page
    assert "200 mm from Z0" in page
    mirror = {**_SPEC, "optics": {**_SPEC["optics"], "surface": "mirror"}}
    assert "within 0.25 µm per mm (0.25 mrad)" in render_report({}, spec=mirror, files=["lens.step"])
