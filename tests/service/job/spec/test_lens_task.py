"""What a person says of light, screen and outline reaches the optics as it was meant: right way round, in place.

The viewer is described by where they stand, as in test_reading, so that the one flipping function is not taken at
its word.
"""

from __future__ import annotations

from math import exp
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from optics.block import Back
from optics.caustic import simulate_caustic
from optics.heightfield import Heightfield
from optics.light import meet, strength_on_face
from service.errors import InputError
from service.job.spec.lens_task import bench_of, explain_blocked_light, lens_settings, require_contrast
from service.job.spec.loading import resolve_spec
from service.job.spec.model import JobSpec

PIXELS = 24


def job(**optics: Any) -> JobSpec:
    return resolve_spec(base={"optics": {"width_mm": 30.0, "height_mm": 20.0, "throw_mm": 60.0, **optics}})


def through_a_flat_lens(spec: JobSpec) -> NDArray[np.float64]:
    """Irradiance on a screen as large as the lens, row 0 at the lowest y: of parallel light, the light itself, as the
    block is clear.
    """
    flat = Heightfield.on_aperture(np.full((25, 25), -0.1), width_mm=30.0, height_mm=20.0)
    return simulate_caustic(flat, bench_of(spec).clear, pixels=(PIXELS, PIXELS)).irradiance


@pytest.mark.parametrize(
    ("stock", "optics", "haze", "back"),
    [
        ({}, {}, 0.01, None),  # as makers state it of cast acrylic; of its back nothing is known
        ({"haze_percent": 0.0}, {}, 0.0, None),
        ({"haze_percent": 5.0, "back_flatness_mm": 0.01}, {}, 0.05, Back(flatness_mm=0.01, period_mm=40.0)),
        ({"back_flatness_mm": 0.0, "back_period_mm": 20.0}, {}, 0.01, None),
        ({"haze_percent": 5.0, "back_flatness_mm": 0.01}, {"surface": "mirror"}, 0.0, None),
    ],
)
def test_a_block_is_as_hazy_and_wavy_as_it_is_said_to_be(
    stock: dict[str, Any], optics: dict[str, Any], haze: float, back: Back | None
) -> None:
    spec = resolve_spec(base={"stock": stock, "optics": optics})
    bench = bench_of(spec)
    assert (bench.haze, bench.back) == (haze, back)
    assert (bench.flawless.haze, bench.flawless.back) == (0.0, None)


def bilinear(rows: list[list[float]], right: NDArray[np.float64], down: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows from rim to rim, at shares of the way to the right and down."""
    given_rows = np.array(rows)
    x, y = right * (given_rows.shape[1] - 1), down * (given_rows.shape[0] - 1)
    i, j = (np.minimum(a.astype(int), n - 2) for a, n in zip((x, y), given_rows.shape[::-1], strict=True))
    f, g = x - i, y - j
    top, bottom = ((1 - f) * given_rows[j + k, i] + f * given_rows[j + k, i + 1] for k in (0, 1))
    return np.asarray((1 - g) * top + g * bottom)


@pytest.mark.parametrize(
    "optics",
    [
        {}, {"light": {"kind": "sun"}}, {"screen_width_mm": 20.0}, {"screen_shift_x_mm": 9.0}, {"outline": "ellipse"},
        {"light": {"kind": "point", "distance_mm": 500.0}}, {"light": {"gaussian_mm": 20.0}},
    ],
)  # fmt: skip
def test_one_tone_is_a_task_where_light_has_to_be_spread_for_it_and_no_other(optics: dict[str, Any]) -> None:
    """Where the window itself shows it, there is nothing to mill."""
    spec, one_tone = job(**optics), np.ones((8, 12))
    if optics in ({}, {"light": {"kind": "sun"}}):
        with pytest.raises(InputError, match="plain window"):
            require_contrast(spec, one_tone)
    else:
        require_contrast(spec, one_tone)
    one_tone[3, 4] += 0.01
    require_contrast(spec, one_tone)


@pytest.mark.parametrize("viewed_from", ["lens", "behind"])
def test_a_flat_lens_shows_the_light_as_the_viewer_has_measured_it(viewed_from: str) -> None:
    """Both viewers stand upright; on the lens's side one looks along +Z and has +X to the left hand."""
    rows = [[1.0, 0.2, 0.6], [0.5, 0.9, 0.1]]
    irradiance = through_a_flat_lens(job(light={"profile": rows}, viewed_from=viewed_from))
    place = (np.arange(PIXELS) + 0.5) / PIXELS
    right = 1 - place if viewed_from == "lens" else place
    wanted = bilinear(rows, *np.broadcast_arrays(right[None, :], 1 - place[:, None]))
    assert irradiance == pytest.approx(wanted / wanted.mean(), abs=2e-3)  # pixel means against samples at their middle


@given(st.floats(16.0, 200.0))
def test_a_gaussian_beam_has_fallen_to_its_square_of_e_at_its_diameter(gaussian_mm: float) -> None:
    beam = bench_of(job(light={"gaussian_mm": gaussian_mm})).beam()
    middle = strength_on_face(beam, 15.0, 10.0)
    for x, y in ((27.0, 10.0), (15.0, 1.0), (20.0, 17.0)):
        share = exp(-8 * ((x - 15) ** 2 + (y - 10) ** 2) / gaussian_mm**2)
        assert strength_on_face(beam, x, y) / middle == pytest.approx(share, abs=1e-3)  # bilinear on 129 points


def test_a_lamp_stands_on_the_axis_at_its_distance_from_the_back() -> None:
    bench = bench_of(job(light={"kind": "point", "distance_mm": 300.0, "size_mm": 4.0}))
    assert bench.thickness_mm == 40.0
    beam = bench.beam()
    assert (beam.x, beam.y, beam.z) == (15.0, 10.0, -340.0)
    rim = bench.beam(aside=(1.0, 0.0))
    assert rim.x - beam.x == pytest.approx(2.0)


def test_the_sun_is_as_wide_as_it_is_said_to_be() -> None:
    bench = bench_of(job(light={"kind": "sun", "size_deg": 2.0}))
    rim = meet(bench.beam(aside=(1.0, 0.0)), 0.0, 0.0, 0.0)
    assert np.degrees(np.arcsin(1.49 * rim[0])) == pytest.approx(1.0, rel=1e-3)  # in air; the radius of the disc


def test_the_screen_stands_where_it_is_said_to() -> None:
    screen = bench_of(job(screen_width_mm=60.0, screen_shift_x_mm=12.0, screen_shift_y_mm=-7.0)).screen
    assert (screen.width_mm, screen.height_mm, screen.centre_x_mm, screen.centre_y_mm) == (60.0, 40.0, 27.0, 3.0)


def test_light_beyond_the_outline_does_not_count() -> None:
    """A flat lens with the outline of a triangle lights that triangle, and evenly."""
    irradiance = through_a_flat_lens(job(outline=[[0, 0], [0, 20], [30, 0]]))
    x, y = np.meshgrid(*[(np.arange(PIXELS) + 0.5) / PIXELS] * 2)
    assert irradiance[x + y < 0.93] == pytest.approx(2.0, rel=0.01)
    assert irradiance[x + y > 1.07].max() < 1e-6


def test_decisions_reach_the_design() -> None:
    spec = job(polish=True, vertices_per_pixel=3, corrections=1, surface="mirror", min_radius_mm=0.7)
    settings = lens_settings(spec, branch="inverted")
    assert (settings.vertices_per_pixel, settings.corrections, settings.min_radius_mm) == (3, 1, 0.7)
    assert settings.polish_steps > 0
    assert (settings.bench.branch, settings.bench.mirror) == ("inverted", True)
    assert lens_settings(job(creases=True), branch="direct").closing_radius_mm == 0.0
    assert lens_settings(job(), branch="direct").polish_steps == 0


def test_the_thickness_of_the_block_is_left_out_where_light_goes_straight() -> None:
    thick = {"stock": {"thickness_mm": 77.0}}
    for optics, counts in (({}, False), ({"surface": "mirror"}, False), ({"light": {"kind": "sun"}}, True)):
        bench = bench_of(resolve_spec(base={"optics": optics, **thick}))
        assert (bench.thickness_mm == 77.0) is counts


@pytest.mark.parametrize(
    ("optics", "is_blocked"),
    [
        ({}, True),
        ({"screen_shift_x_mm": 29.0}, True),
        ({"screen_shift_x_mm": 31.0}, False),
        ({"screen_shift_y_mm": -21.0}, False),
        ({"light": {"kind": "point", "distance_mm": 50.0}}, False),  # nearer than the screen
        ({"light": {"kind": "point", "distance_mm": 120.0}, "screen_shift_x_mm": 23.0}, False),  # the cone is narrower
        ({"light": {"kind": "point", "distance_mm": 120.0}, "screen_shift_x_mm": 22.0}, True),
    ],
)
def test_a_screen_in_the_light_of_a_mirror_is_told(optics: dict[str, Any], is_blocked: bool) -> None:
    assert (explain_blocked_light(job(surface="mirror", **optics)) is not None) is is_blocked
    assert explain_blocked_light(job(**optics)) is None
