"""Ball end mills: the largest ball a lens admits; start values of speeds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.cutters import BALL
from cam.errors import CamError, PassValueError
from cam.materials import PMMA
from cam.passes import PRESETS, PassSpec, ball_pass
from cam.surface.stock_touch import find_reached_share, largest_fitting_radius_mm
from tests.cam.lenses import make_lens


@pytest.mark.parametrize(("radius_mm", "pitch_mm", "cusp_um"), [(3, 0.5, 10.4), (0.5, 0.05, 0.6), (0.5, 0.02, 0.1)])
def test_cusps_of_the_papers_passes(radius_mm, pitch_mm, cusp_um):
    assert 1e3 * BALL.cusp_mm(radius_mm, pitch_mm) == pytest.approx(cusp_um, rel=0.05)


def test_largest_ball_in_a_paraboloid():
    """The bottom of z = x^2 / 2B + y^2 / 4B has principal curvatures 1/B and 1/2B; nowhere is it more hollow."""
    lens = make_lens(lambda x, y: (x - 4) ** 2 / 5 + (y - 3) ** 2 / 10)
    assert largest_fitting_radius_mm(lens).everywhere_mm == pytest.approx(2.5, rel=1e-6)
    assert largest_fitting_radius_mm(lens).nearly_mm >= 2.5
    assert find_reached_share(lens, 2.49) == 1.0
    assert 0.0 < find_reached_share(lens, 4.0) < 1.0


def test_a_hill_admits_every_ball():
    dome = make_lens(lambda x, y: -((x - 4) ** 2) / 5 - (y - 3) ** 2 / 10)
    assert largest_fitting_radius_mm(dome).everywhere_mm == np.inf


@given(st.floats(0.05, 20.0))
def test_start_values_lie_between_their_neighbours(radius_mm):
    start = PMMA.start_values(radius_mm)
    for name in ("spindle_rpm", "feed_mm_per_tooth", "step_down_mm", "plunge_share"):
        known = [getattr(c, name) for c in PMMA.cutting]
        assert min(known) * 0.999 <= getattr(start, name) <= max(known) * 1.001
    assert start.plunge_mm_per_min < start.feed_mm_per_min


def test_presets_are_data():
    """Radii, pitches and what is left of the paper's three passes; every preset ends with a finish."""
    paper = [(p.radius_mm, p.pitch_mm, p.stock_to_leave_mm) for p in PRESETS["paper"]]
    assert paper == [(3.0, 0.5, 0.2), (0.5, 0.05, 0.03), (0.5, 0.02, 0.0)]
    assert all(passes[-1].finishes and not passes[0].finishes for passes in PRESETS.values())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("pitch_mm", 0.0),
        ("pitch_mm", -0.1),
        ("pitch_mm", 0.6),
        ("pitch_mm", float("nan")),
        ("radius_mm", 0.0),
        ("step_down_mm", 0.0),
        ("stock_to_leave_mm", -0.01),
        ("feed_mm_per_min", float("inf")),
        ("link", "teleport"),
        ("strategy", "spiral"),
    ],
)
def test_a_bad_value_is_named(name, value):
    good = {f: getattr(PRESETS["paper"][1], f) for f in PassSpec.__slots__}
    with pytest.raises(PassValueError) as error:
        PassSpec(**{**good, name: value})
    assert error.value.name == name
    assert name in str(error.value)
    assert isinstance(error.value, CamError)


def test_an_unknown_radius_has_no_speeds():
    with pytest.raises(PassValueError):
        ball_pass("p", radius_mm=-1.0, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.1)
