"""What the setup sheet says of the picture as milled, and its silence where nothing is known."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from service.job.report.figures.wall import as_milled_png, busiest_part
from service.job.report.milled import CAUSES, detail_lost, sentences_as_milled
from tests.service.job.report.sheet import render_report

MILLED = {
    "psnr_db": 24.4, "seen_db": 15.0, "psnr_db_designed": 41.0, "seen_db_designed": 34.0,
    "ssim": 0.73, "misplaced_light": 0.05, "dark_leak": 0.0,
    "slope_rms_mrad": 11.9, "blur_px": 2.9, "blur_x_px": 0.1, "blur_y_px": 2.9, "step_mm": 0.002, "z_noise_mm": 0.0005,
    "gain_db_without": {"scallops": 1.0, "steps": 3.2, "noise": 0.4, "rounding": 0.0},
}  # fmt: skip


def test_the_sheet_says_what_to_expect_and_what_costs_most():
    told = " ".join(sentences_as_milled(MILLED, finished=True))
    for word in ("24.4 dB", "41.0 dB", "11.9 mrad", "2.9 in Y", "2 µm", "0.5 µm", "3.2 dB", *CAUSES["steps"]):
        assert word in told
    assert sentences_as_milled({}, finished=True) == []
    quiet = {**MILLED, "gain_db_without": dict.fromkeys(CAUSES, 0.1)}
    assert len(sentences_as_milled(quiet, finished=True)) == 2
    assert "olish" not in " ".join(sentences_as_milled(MILLED, finished=False)), "nobody is to finish this lens"


def test_the_page_has_words_for_every_cause():
    script = (Path(__file__).parents[4] / "service" / "page" / "job" / "figures.js").read_text()
    table = re.search(r"const CAUSES = \{(.*?)\n\};", script, re.DOTALL)
    assert table is not None
    assert set(re.findall(r"^  (\w+): \[", table.group(1), re.MULTILINE)) == set(CAUSES)


@pytest.mark.parametrize("gain", [0.4, 2.3, 9.9, 15.0])
def test_what_one_cause_brings_is_told_beside_what_all_of_them_cost(gain: float):
    """2.3 dB beside a loss of 15 dB reads as a contradiction unless it is said where the rest is."""
    lossy = {**MILLED, "psnr_db": 15.0, "psnr_db_designed": 30.0}
    told = sentences_as_milled({**lossy, "gain_db_without": {"scallops": gain, "steps": gain / 2}}, finished=True)[1]
    assert f"{gain:.1f} dB" in told and CAUSES["scallops"][0] in told
    explains_it_all = gain > 0.7 * 15
    assert ("15.0 dB" in told and CAUSES["steps"][0] in told) is not explains_it_all


@pytest.mark.parametrize(("seen_db", "words"), [(8.0, "hard to recognise"), (20.0, "plainly the picture")])
def test_a_figure_never_stands_without_what_an_eye_makes_of_it(seen_db: float, words: str):
    assert f"(24.4 dB): {words}" in sentences_as_milled({**MILLED, "seen_db": seen_db}, finished=True)[0]


def test_a_lens_that_is_made_for_its_marks_is_not_to_be_polished():
    sharpened = " ".join(sentences_as_milled({**MILLED, "psnr_db": 22.8, "psnr_db_designed": 16.8}, finished=False))
    assert "Do not polish it" in sharpened and "16.8 dB" in sharpened
    assert "Do not polish" not in " ".join(sentences_as_milled(MILLED, finished=True))


def test_a_blur_of_more_than_a_pixel_is_a_warning():
    for planned in (False, True):  # what one will see first, figures last
        told = detail_lost(MILLED, planned=planned) or ""
        assert told.startswith("the picture's fine detail will not be seen") and told.endswith("2.9 of its pixels)")
    assert "“Recommended”" in (detail_lost(MILLED) or "")
    assert "Recommended" not in (detail_lost(MILLED, planned=True) or "")  # it was asked already
    assert detail_lost({**MILLED, "blur_y_px": 0.9}) is None
    assert detail_lost({**MILLED, "psnr_db_blurred": 30.0})
    assert detail_lost({**MILLED, "psnr_db_blurred": 42.0}) is None  # a soft picture has nothing so fine


def test_the_page_shows_the_picture_beside_the_design():
    page = render_report({"as_milled": MILLED}, files=["caustic.png", "caustic-as-milled.png", "as-milled.png"])
    assert 'src="caustic-as-milled.png"' in page
    assert 'src="as-milled.png"' in page
    assert "the largest part comes from" in page
    assert "As milled: light in wrong places" in page


@pytest.mark.parametrize("shape", [(16, 16), (40, 90), (200, 30)])
def test_the_enlarged_part_lies_in_the_picture_where_it_changes(shape):
    picture = np.zeros(shape)
    picture[shape[0] // 2 :: 2, shape[1] // 2 :: 2] = 1.0
    rows, columns = busiest_part(picture)
    assert np.abs(np.diff(picture[rows, columns])).sum() > 0
    assert rows.stop <= shape[0]
    assert columns.stop <= shape[1]
    assert as_milled_png(picture + 0.1, picture, picture, figures=MILLED).startswith(b"\x89PNG")
