"""The closed forms and Newton steps of the optical path, against the equation that they solve, for any beam."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from optics.bench import Bench
from optics.light import Beam, Light, leave, meet, strength_on_face
from optics.transport.beam_path import fill_heights, trace_back

WIDTH, THROW = 50.0, 120.0
aside = st.floats(-0.2, 0.2)


@st.composite
def beams(draw: st.DrawFn) -> Beam:
    tilt = (draw(aside), draw(aside))
    kind = draw(st.sampled_from(["collimated", "point"]))
    light = Light(kind=kind, distance_mm=draw(st.floats(60.0, 3000.0)), tilt_rad=tilt)  # type: ignore[arg-type]
    index, mirror = draw(st.floats(1.3, 2.0)), draw(st.booleans())
    return Bench.centre_on(
        width_mm=WIDTH, height_mm=WIDTH, throw_mm=THROW, refractive_index=index, mirror=mirror, light=light
    ).beam()


points = st.tuples(st.floats(0.0, WIDTH), st.floats(0.0, WIDTH), st.floats(-20.0, 0.0))


@hypothesis_settings(max_examples=60)
@given(beam=beams(), point=points, sx=aside, sy=aside)
def test_a_ray_is_traced_back_to_where_it_left(
    beam: Beam, point: tuple[float, float, float], sx: float, sy: float
) -> None:
    """From q, the direction of arrival and the path's length alone; and the height from q, p and the path alone."""
    sz = np.sqrt(1 - sx**2 - sy**2)
    ray = (THROW - point[2]) / sz
    q = (point[0] + ray * sx, point[1] + ray * sy)
    *d, phase, face_x, face_y = meet(beam, *point)
    if not beam.is_mirror and beam.refractive_index * np.dot(d, (sx, sy, sz)) < 1.05:
        return  # light is not turned that far
    found = trace_back(beam, *q, THROW, phase + ray, sx, sy, np.nan)
    np.testing.assert_allclose(found, (ray, *point, face_x, face_y), atol=1e-7)
    t = np.empty((1, 1))
    x, y, qx, qy, path = (np.array([value]) for value in (point[0], point[1], q[0], q[1], phase + ray))
    fill_heights(0, 1, path[None], qx[None], qy[None], x, y, THROW, beam, t)
    assert t[0, 0] == pytest.approx(point[2], abs=1e-7)


@hypothesis_settings(max_examples=60)
@given(beam=beams(), point=points)
def test_the_phase_grows_along_the_beam(beam: Beam, point: tuple[float, float, float]) -> None:
    """grad phase = n d: the eikonal equation, which is what makes the path stationary in p."""
    d, h = np.array(meet(beam, *point)[:3]), 1e-3
    assert np.linalg.norm(d) == pytest.approx(1.0, abs=1e-12)
    for axis in range(3):
        ends = [meet(beam, *(np.array(point) + sign * h * np.eye(3)[axis]))[3] for sign in (-1, 1)]
        assert (ends[1] - ends[0]) / (2 * h) == pytest.approx(beam.refractive_index * d[axis], abs=1e-7)


@hypothesis_settings(max_examples=60)
@given(beam=beams(), point=points, sx=aside, sy=aside)
def test_the_surface_normal_is_what_snell_asks(
    beam: Beam, point: tuple[float, float, float], sx: float, sy: float
) -> None:
    """A surface along n d - s sends the beam along s (a mirror: along s - d)."""
    s = np.array([sx, sy, np.sqrt(1 - sx**2 - sy**2)])
    d = np.array(meet(beam, *point)[:3])
    normal = beam.refractive_index * d - s
    if not beam.is_mirror and normal @ s < 0.05:
        return
    slope = -normal[:2] / normal[2]
    sent = leave(d[0], d[1], d[2], slope[0], slope[1], beam.refractive_index, beam.is_mirror)
    np.testing.assert_allclose(np.array(sent), s, atol=1e-9)


@pytest.mark.parametrize(("x", "y"), [(np.nan, 5.0), (5.0, np.nan), (np.inf, 5.0), (5.0, -np.inf)])
def test_no_place_has_no_light(x: float, y: float) -> None:
    """A ray that was lost on its way names no cell of a profile: reading one would leave the array."""
    light = Light(profile=np.ones((3, 4)))
    bench = Bench.centre_on(width_mm=20.0, height_mm=20.0, throw_mm=40.0, refractive_index=1.49, light=light)
    assert np.isnan(strength_on_face(bench.beam(), x, y))
