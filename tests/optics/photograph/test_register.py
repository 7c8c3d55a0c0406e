"""A photograph is found: where the picture lies in it, how it was exposed, and when it is none of this picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import gaussian_filter

from optics.irradiance import flip_between_picture_and_work_frame, target_irradiance
from optics.photograph import register
from optics.photograph.homography import enclose_quadrilateral, homography_of_points, normalise_homography
from optics.photograph.views import area_average
from optics.spline import Array
from tests.optics.photographs import Shot, camera, moved, photographed

EXAMPLES = Path(__file__).parents[3] / "examples"
WIDE, HIGH = 96, 72
MARGIN = 0.2
SHAPE = (450, 600)


def picture(seed: int = 5, fine: int = 3) -> Array:
    """Soft blobs, sharp bars and a dark corner, HIGH x WIDE times `fine`, as the viewer sees them."""
    generator = np.random.default_rng(seed)
    y, x = np.mgrid[0 : HIGH * fine, 0 : WIDE * fine] / (WIDE * fine)
    light = np.full(x.shape, 0.15)
    for _ in range(18):
        u, v, size, height = generator.uniform([0, 0, 0.015, 0.2], [1, 0.75, 0.1, 1.2])
        light += height * np.exp(-((x - u) ** 2 + (y - v) ** 2) / size**2)
    for _ in range(6):
        u, v, wide, high = generator.uniform([0, 0, 0.02, 0.02], [0.9, 0.65, 0.2, 0.2])
        light[(abs(x - u) < wide) & (abs(y - v) < high)] *= generator.uniform(0.3, 1.6)
    return np.asarray(light / light.mean())


def predicted(seen: Array) -> Array:
    """The same in the work frame, in the prediction's own pixels."""
    return target_irradiance(area_average(seen, (HIGH, WIDE)), viewed_from="lens")


def shot_of(seen: Array, *, mirrored: bool = False, at: dict[str, Any] | None = None, **conditions: Any) -> Shot:
    rim = round(MARGIN * seen.shape[1]), round(MARGIN * seen.shape[0])
    wall = np.pad(seen, ((rim[1], rim[1]), (rim[0], rim[0])))
    homography = camera(aspect=WIDE / HIGH, shape=SHAPE, **(at or {"aside_deg": 20.0}))
    return photographed(wall, homography, margin=MARGIN, mirrored=mirrored, shape=SHAPE, **conditions)


def missed_px(homography: Array, shot: Shot) -> float:
    """Root mean square over the picture, in its own pixels."""
    points, places = shot.places()
    found = moved(np.linalg.inv(homography), places)
    return float(np.sqrt(np.mean(np.sum((found - points * (WIDE, HIGH)) ** 2, axis=1))))


@settings(max_examples=8)
@given(
    aside_deg=st.floats(-30, 30),
    above_deg=st.floats(-15, 15),
    roll_deg=st.floats(-10, 10),
    quarter_turns=st.integers(0, 3),
    stops=st.floats(-2, 1),
    seed=st.integers(0, 99),
)
def test_a_picture_is_found_from_any_side_at_any_exposure(
    aside_deg: float, above_deg: float, roll_deg: float, quarter_turns: int, stops: float, seed: int
) -> None:
    """To a tenth of its pixels, and its turn to a fifth of a degree, whatever the camera's place, roll and exposure."""
    place = {"aside_deg": aside_deg, "above_deg": above_deg, "roll_deg": roll_deg, "quarter_turns": quarter_turns}
    seen = picture(seed)
    shot = shot_of(seen, at=place, stops=stops, seed=seed, shading=0.1)
    found = register(shot.photo, predicted(seen))
    assert missed_px(found.homography, shot) < 0.15
    turned = np.degrees(found.rotation_rad) - roll_deg - 90.0 * quarter_turns
    assert (turned + 180) % 360 - 180 == pytest.approx(0.0, abs=0.2)
    assert found.confidence == 1.0
    assert not found.mirrored


@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_white_in_the_photograph_neither_pulls_nor_is_believed(seed: int) -> None:
    """Two stops too long: most of the picture is white, and its place is still known to half a pixel."""
    seen = picture(seed)
    shot = shot_of(seen, at={"aside_deg": 30.0}, stops=2.0)
    found = register(shot.photo, predicted(seen))
    assert found.clipped_share > 0.3
    assert missed_px(found.homography, shot) < 0.5
    assert found.confidence == 1.0
    assert found.residual * predicted(seen).std() < 0.1


def test_the_rectified_photograph_is_the_prediction_in_its_own_units() -> None:
    """Work frame and mean 1, whatever the exposure: gain and offset are undone."""
    seen = picture()
    shot = shot_of(seen, stops=-1.0, background=0.03, blur_px=0.7, noise=0.003)
    found = register(shot.photo, predicted(seen))
    off = (found.rectified - predicted(seen))[found.usable]
    assert found.usable.mean() > 0.99
    assert np.sqrt(np.mean(off**2)) < 0.06 * predicted(seen).std()
    assert found.offset == pytest.approx(0.03, abs=0.002)


@pytest.mark.parametrize("blur_px", [2.0, 5.0])
def test_blur_is_told_in_pixels_of_the_prediction(blur_px: float) -> None:
    """To a fifth, whatever sampling adds."""
    seen = picture()
    shot = shot_of(seen, at={"aside_deg": 0.0}, blur_px=blur_px)
    found = register(shot.photo, predicted(seen))
    assert found.blur_px * found.pixels_per_pixel == pytest.approx(blur_px, rel=0.2)


def test_a_photograph_that_is_sharper_than_foretold_has_a_negative_blur() -> None:
    seen = picture()
    soft = area_average(seen, (HIGH, WIDE))
    found = register(
        shot_of(seen, blur_px=1.0).photo, target_irradiance(gaussian_filter(soft, 1.5), viewed_from="lens")
    )
    assert found.blur_px == pytest.approx(-1.5, rel=0.25)


def test_a_mirrored_picture_is_said_to_be_mirrored() -> None:
    """And found all the same: each of its points lies where its mirror image was photographed."""
    seen = picture()
    shot = shot_of(seen, mirrored=True, at={"aside_deg": 25.0, "quarter_turns": 1})
    found = register(shot.photo, predicted(seen))
    assert found.mirrored
    assert found.confidence == 1.0
    points, places = shot.places()
    back = moved(np.linalg.inv(found.homography), places) / (WIDE, HIGH)
    assert np.abs(back - np.stack([1 - points[:, 0], points[:, 1]], axis=1)).max() * WIDE < 0.3


@pytest.mark.thorough
def test_a_symmetric_picture_is_not_said_to_be_mirrored() -> None:
    """Mirrored it fits as well as upright: no reason to alarm anybody."""
    half = picture()
    seen = half + half[:, ::-1]
    assert not register(shot_of(seen).photo, predicted(seen)).mirrored


def test_seen_from_behind_columns_stay_as_they_are() -> None:
    """A translucent screen photographed from behind: the work frame's x runs to the right."""
    seen = picture()
    behind = flip_between_picture_and_work_frame(area_average(seen, (HIGH, WIDE)), "behind")
    found = register(shot_of(seen).photo, behind, viewed_from="behind")
    assert not found.mirrored
    assert found.confidence == 1.0
    assert np.corrcoef(found.rectified.ravel(), behind.ravel())[0, 1] > 0.99


@pytest.mark.parametrize(("wanted", "shown"), [("logo", "camera"), ("camera", "logo"), ("astronaut", "camera")])
def test_a_photograph_of_another_picture_is_not_believed(wanted: str, shown: str) -> None:
    """Not even one whose bright and dark parts a perspective and a blur bring together."""
    pictures = [
        np.asarray(Image.open(EXAMPLES / f"{name}.png").convert("L").resize((192, 192)), dtype=np.float64) ** 2.2
        for name in (wanted, shown)
    ]
    wall = np.pad(pictures[1], 38)
    shot = photographed(wall, camera(aside_deg=20.0, roll_deg=3.0), margin=38 / 192)
    found = register(shot.photo, target_irradiance(area_average(pictures[0], (96, 96)), viewed_from="lens"))
    assert found.confidence < 0.5


def test_a_tone_of_the_camera_s_own_is_found_where_it_is_asked_for() -> None:
    seen = picture()
    found = register(shot_of(seen, gamma=1.25, background=0.0).photo, predicted(seen), fit_tone=True)
    assert found.tone == pytest.approx(1.25, rel=0.1)
    assert register(shot_of(seen).photo, predicted(seen)).tone == 1.0


@pytest.mark.thorough
def test_strangers_in_the_photograph_do_not_pull() -> None:
    """A lamp beside the picture, a finger before it, a tape on the wall: large residuals count little."""
    seen = picture()
    shot = shot_of(seen)
    photo = shot.photo.copy()
    photo[400:430, 50:110] = 1.0
    photo[80:90, 540:] = 0.4
    photo[150:200, 180:230] *= 0.2
    photo[260:330, 380:400] = 0.7
    assert missed_px(register(photo, predicted(seen)).homography, shot) < 0.15


@pytest.mark.parametrize(
    "photo", [np.zeros((40, 50)), np.full((40, 50), 0.5), np.full((4, 4), 1.0), np.full((40, 50), np.nan)]
)
def test_what_is_no_photograph_of_light_is_refused(photo: Array) -> None:
    with pytest.raises(ValueError, match="photograph"):
        register(photo, predicted(picture()))


def test_four_points_make_a_homography() -> None:
    source = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    image = np.array([[100.0, 80], [700, 120], [640, 560], [90, 500]])
    found = homography_of_points(source, image)
    assert np.allclose(moved(found, source), image)
    assert np.allclose(normalise_homography(5 * found), found)


def test_a_quadrilateral_with_its_corners_cut_off_is_made_whole() -> None:
    corners = np.array([[0.0, 0], [10, 1], [9, 8], [1, 7]])
    cut = []
    for k in range(4):
        before, here, after = corners[k - 1], corners[k], corners[(k + 1) % 4]
        cut += [here + 0.05 * (before - here), here + 0.08 * (after - here)]
    assert np.allclose(enclose_quadrilateral(np.array(cut)), corners) or np.allclose(
        np.sort(enclose_quadrilateral(np.array(cut)), axis=0), np.sort(corners, axis=0)
    )


def test_averages_over_areas_keep_the_sum() -> None:
    light = np.random.default_rng(0).uniform(size=(37, 53))
    for shape in ((10, 20), (37, 53), (50, 60)):
        assert area_average(light, shape).mean() == pytest.approx(light.mean())
