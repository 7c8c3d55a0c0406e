"""What the setup sheet says of light, screen, surface and tolerances, and its silence where nothing is known."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from optics.tolerance import BlurPoint, FocusPoint, TiltPoint, Tolerances
from service.cli.summary import summary_lines
from service.job.report.block import BlockSizes, side_view
from service.job.report.figures.wall import tolerances_png
from service.job.report.optics import lens_rows, light_sentences, score_rows, screen_sentence, tolerance_sentences
from service.job.spec.lens_task import source_spread_mm
from tests.service.job.report.sheet import render_report

TOLERANCES: dict[str, Any] = {
    "psnr_db": 41.0,
    "focus": [{"offset_mm": o, "psnr_db": p} for o, p in ((-2, 24.0), (-1, 29.0), (0, 41.0), (1, 30.0), (2, 25.0))],
    "focus_range_mm": [-0.25, 0.3],
    "tilts": [{"tilt_deg": 0.5, "shift_mm": [0.6, 0.8], "psnr_db": 35.0}],
    "sources": [{"size_deg": 0.53, "diameter_mm": 0.93, "diameter_px": 4.7, "psnr_db": 26.6}],
    "blur_mm": 0.0,
    "blur_px": 0.0,
}
CLOSING = {
    "radius_mm": 0.5, "psnr_db_without": 37.0, "psnr_db_with": 36.4,
    "dark_leak_without": 0.017, "dark_leak_with": 0.018,
}  # fmt: skip
POLISH = {"steps": 20, "psnr_db_before": 43.2, "psnr_db_after": 48.0, "change_um_rms": 1.21}


def optics(**values: Any) -> dict[str, Any]:
    return {"optics": {"seen_db": 30.0, **values}}


def test_the_sheet_says_what_the_ball_and_the_polish_did() -> None:
    rows = dict(lens_rows(optics(closing=CLOSING, polish=POLISH), {}))
    assert (
        rows["Valleys filled for a ball R 0.5 (Ø 1 mm)"] == "costs 0.6 dB, light where it should be dark 1.70 → 1.80 %"
    )
    assert rows["Polish"].startswith("20 steps, +4.8 dB, moves the surface by 1.21 µm rms")
    free = CLOSING | {"psnr_db_with": 36.99, "dark_leak_with": 0.0}
    assert dict(lens_rows(optics(closing=free), {}))["Valleys filled for a ball R 0.5 (Ø 1 mm)"] == "costs nothing"
    assert lens_rows(optics(closing=None, polish=None), {}) == []


def test_curvature_and_balls_are_told_for_shares_of_the_area() -> None:
    curvature = {"p50": 0.01, "p90": 0.1, "p99": 0.3, "p99.9": 0.4, "p100": 2.0}
    rows = lens_rows(
        optics(min_concave_radius_mm=0.5, concave_radius_999_mm=2.5, concave_curvature_per_mm=curvature), {}
    )
    assert rows == [
        ("Largest ball that fits everywhere", "R 0.5 (Ø 1 mm)"),
        ("99.9 % of the lens: a ball up to", "R 2.5 (Ø 5 mm) fits"),
        ("Hollow curvature, 1/mm", "half of the area up to 0.01, 90 % up to 0.1, 99.9 % up to 0.4, most 2"),
    ]


def test_dark_leak_stands_beside_what_physics_allows() -> None:
    rows = score_rows(optics(psnr_db=33.0, dark_leak=0.018, dark_leak_estimate=0.008, min_radius_mm=0.5))
    what, figure, words = rows[-1]
    assert (what, figure) == ("Lens itself: light where it should be dark", "1.80 %")
    assert "ball R 0.5 (Ø 1 mm)" in words
    assert "0.80 %" in words
    assert [row[0] for row in score_rows(optics(psnr_db=33.0, dark_leak=0.0))] == [
        "Lens itself: likeness (PSNR)"
    ]  # nothing is black


@pytest.mark.parametrize(
    ("light", "best_db", "figure", "words"),
    [
        (
            {"spectrum": "white", "dispersion": 0.0085},
            41.0,
            "a white LED",
            "at one wavelength the lens itself shows 41.0",
        ),
        ({"spectrum": "monochromatic", "dispersion": 0.0085}, None, "light of one wavelength", "another distance"),
        ({"spectrum": {"centre_nm": 530, "width_nm": 35}, "dispersion": 0.0085}, None, "an LED of 530 nm", "another"),
        ({"spectrum": "sun", "dispersion": None}, None, "sunlight", "is unknown: all colours are treated alike"),
        ({"spectrum": "white", "dispersion": 0.0}, None, "a white LED", "a mirror sends all colours the same way"),
    ],
)
def test_scores_say_under_which_light_they_hold(
    light: dict[str, Any], best_db: float | None, figure: str, words: str
) -> None:
    *_, row = score_rows(optics(psnr_db=33.0, light=light, psnr_db_one_wavelength=best_db))
    assert row[0] == "Light"
    assert row[1].startswith(figure)
    assert words in row[2]


def test_index_and_wall_are_stated_together() -> None:
    point = {"more_index": 0.0026, "psnr_db": 28.0, "wall_mm": -0.65, "psnr_db_moved": 40.0}
    sentence = tolerance_sentences(TOLERANCES | {"index": point}, throw_mm=100.0)[1]
    assert "known to ±0.0026 only" in sentence
    assert "move the wall by up to 0.65 mm nearer or farther, which brings back up to 12.0 dB" in sentence
    without = tolerance_sentences(TOLERANCES, throw_mm=100.0)
    for nothing in (None, point | {"psnr_db_moved": 28.0}):
        assert tolerance_sentences(TOLERANCES | {"index": nothing}, throw_mm=100.0) == without


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, ["parallel", "square to the flat back"]),
        ({"surface": "mirror"}, ["parallel", "milled face"]),
        ({"light": {"kind": "sun", "size_deg": 0.53}}, ["the sun's"]),
        (
            {"light": {"kind": "point", "distance_mm": 500.0, "size_mm": 0.0}},
            ["small lamp", "500 mm from the flat back"],
        ),
        ({"light": {"kind": "point", "distance_mm": 500.0, "size_mm": 3.0}}, ["lamp of 3 mm"]),
        ({"surface": "mirror", "light": {"kind": "point", "distance_mm": 500.0}}, ["500 mm from the stock top"]),
        ({"light": {"kind": "collimated", "spectrum": "white"}}, ["The lens is made for a white LED."]),
        ({"light": {"kind": "collimated", "gaussian_mm": 90.0}}, ["90 mm wide"]),
        ({"light": {"kind": "collimated", "profile": [[1, 2], [3, 4]]}}, ["uneven as measured"]),
        ({"outline": "ellipse"}, ["mask"]),
    ],
)
def test_the_light_is_described_as_it_has_to_be(given: dict[str, Any], words: list[str]) -> None:
    text = " ".join(light_sentences(optics(**given)))
    assert all(word in text for word in words), text


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [(0, 0, None), (20, 0, "20 mm to the left of"), (-20, 5, "to the right and 5 mm above"), (0, -5.5, "5.5 mm below")],
)
def test_a_picture_aside_is_told_as_seen_from_the_lens(x: float, y: float, words: str | None) -> None:
    """Who looks from the lens along +Z with +Y up has +X to the left."""
    sentence = screen_sentence(optics(screen_shift_x_mm=x, screen_shift_y_mm=y))
    assert sentence is None if words is None else words in str(sentence)


def test_a_source_s_disc_on_the_wall() -> None:
    assert source_spread_mm(optics(light={"kind": "sun", "size_deg": 0.53}), 100.0) == pytest.approx(0.925, abs=1e-3)
    lamp = {"kind": "point", "size_mm": 2.0, "distance_mm": 400.0}
    assert source_spread_mm(optics(light=lamp), 100.0) == pytest.approx(0.5)
    assert source_spread_mm(optics(light={"kind": "collimated"}), 100.0) is None


def test_tolerances_are_sentences_with_the_worse_side() -> None:
    distance, tilt, sun = tolerance_sentences(TOLERANCES, throw_mm=100.0)
    assert "(1 mm) costs 12.0 dB" in distance
    assert "0.25 mm too near or 0.3 mm too far" in distance
    assert "0.5° moves the picture by 1 mm and also costs 6.0 dB" in tilt
    assert "0.93 mm, 4.7 pixels, and leave 27 dB" in sun
    own = tolerance_sentences(TOLERANCES | {"blur_mm": 2.0, "blur_px": 3.0}, throw_mm=100.0)
    assert "made for spreads each point over 2 mm on the wall, 3 pixels" in own[-1]
    assert len(own) == 3
    assert tolerance_sentences({}, throw_mm=100.0) == []


def test_the_page_shows_the_lens_s_own_tolerances_in_place_of_the_general_ones() -> None:
    spec = {
        "optics": {"width_mm": 100.0, "height_mm": 100.0, "throw_mm": 100.0, "screen_shift_x_mm": 20.0},
        "stock": {"thickness_mm": 40.0, "margin_mm": 5.0},
    }
    own = render_report(optics(psnr_db=41.0, tolerances=TOLERANCES), spec=spec, files=["tolerances.png"])
    general = render_report(optics(psnr_db=41.0), spec=spec)
    assert "costs 12.0 dB" in own
    assert "about 7 dB" not in own
    assert 'src="tolerances.png"' in own
    assert "20 mm to the left" in own
    assert "about 7 dB" in general
    assert "tolerances.png" not in general


@pytest.mark.parametrize("is_mirror", [False, True])
@pytest.mark.parametrize("lamp_mm", [None, 500.0])
def test_the_drawing_shows_where_light_comes_from(is_mirror: bool, lamp_mm: float | None) -> None:
    job = BlockSizes(
        width_mm=100, height_mm=100, thickness_mm=40, margin_mm=5, throw_mm=200, is_mirror=is_mirror, lamp_mm=lamp_mm
    )
    drawing = str(side_view(job))
    assert ("from the wall's side" in drawing) is is_mirror
    assert ("lamp, 500 mm away" in drawing) is (lamp_mm is not None)
    assert ("parallel light" in drawing) is (lamp_mm is None)


def test_the_summary_says_what_the_set_up_must_keep_to(tmp_path: Any) -> None:
    facts = {"psnr_db": 41.0, "ssim": 0.99, "misplaced_light": 0.01, "relief_mm": 20.0, "max_slope_deg": 20.0}
    light = {"spectrum": "white", "dispersion": 0.0085, "words": "a white LED"}
    told = optics(
        **facts, light=light, closing=CLOSING, polish=POLISH, dark_leak=0.018, branch="inverted", tolerances=TOLERANCES
    )
    lines = list(summary_lines(tmp_path, told))
    assert (
        "light: all figures hold under a white LED, shaped for a ball R 0.5 (Ø 1 mm) (-0.6 dB), polished (+4.8 dB), "
        "dark leak 1.80 %, rays cross before the screen"
    ) in lines
    assert "set-up: 3 dB are lost with the wall 0.25 mm too near or 0.3 mm too far" in lines
    assert not any(line.startswith(("light:", "set-up:")) for line in summary_lines(tmp_path, optics(**facts)))


@pytest.mark.parametrize("shape", [(40, 40), (20, 80), (80, 20)])
def test_tolerances_are_drawn_for_pictures_of_any_shape(shape: tuple[int, int]) -> None:
    picture = np.random.default_rng(1).random(shape)
    found = Tolerances(
        psnr_db=40.0,
        focus=tuple(FocusPoint(offset_mm=o, psnr_db=40 - 5 * abs(o), irradiance=picture) for o in (-2.0, 0.0, 2.0)),
        focus_range_mm=(-0.6, 0.7),
        tilts=(TiltPoint(tilt_deg=1.0, shift_mm=(2.0, 0.0), psnr_db=30.0, irradiance=picture),),
        sources=(BlurPoint(size_deg=0.53, diameter_mm=1.0, diameter_px=3.0, psnr_db=28.0, irradiance=picture),),
        blur_mm=0.0,
        blur_px=0.0,
    )
    png = tolerances_png(found, [("a", picture), ("b", picture)], white=1.0)
    assert Image.open(io.BytesIO(png)).size[0] > 1000
