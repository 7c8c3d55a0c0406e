"""The setup sheet in other languages: nothing that it says is written past their tables."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import cache
from html import unescape
from typing import Any

import pytest

from docs.languages import PLACEHOLDER, SAME, TABLES, keys_of_the_page, keys_of_the_server
from phrases.phrase import Phrase, phrases_in
from service.job.files import is_drawing, page_in
from service.job.report import setup_sheet
from service.job.report.milled import detail_lost
from service.job.report.pictures import PICTURES
from service.job.report.setup_sheet import LANGUAGES, describe_setup, render_page
from tests.service.job.report.test_milled import MILLED
from tests.service.job.report.test_optics import CLOSING, POLISH, TOLERANCES
from tests.service.job.report.test_setup_sheet import PASSED, PROGRAM, REPORT, SPEC
from tests.service.job.spec.test_finish_library import SEEN, told

# Each entry stands between two letters that nobody sees; what stands in for a placeholder is outside of them.
BEGIN, END = "\N{ZERO WIDTH SPACE}", "\N{SOFT HYPHEN}"
NAMES = re.compile(r"\b(?:face|blob|rough|witness|cut-out|transport|[0-9a-f]{64}|[GMP]\d+|[md]|mrad|px)\b")
MAKERS = re.compile("Harvey Tool|AST Tooling|Shapeoko CNC A to Z")
CURVATURE = {"p50": 0.01, "p90": 0.1, "p99.9": 0.4, "p100": 2.0}
LAST = PASSED | {
    "file": "pass-2-finish.nc",
    "unreached": [{"x_mm": 31.25, "y_mm": 40.5, "excess_um": 3.14, "area_mm2": 0.02}],
    "unreached_share": 0.001,
    "notes": [detail_lost(MILLED)],
    "rest": {"area_mm2": 66.42, "regions": 4},
    "contour": {"aligned_share": 0.981},
    "flute_length_mm": 12.0,
    "link": "retract",
    "where": "rest",
    "radius_mm": 0.5,
    "corner_radius_mm": 0.2,
    "shank_radius_mm": 3.0,
}
FACED = PROGRAM | {"file": "pass-0-face.nc", "above_mm": 0.5, "left_um": 1.0, "radius_mm": 3.0}
CUT = PROGRAM | {"file": "pass-3-cut-out.nc", "clear_um": 3.0, "tabs": [{"height_mm": 0.3}], "radius_mm": 0.25}
MARKS = PROGRAM | {"file": "pass-3-witness.nc", "name": "witness", "tool": "ball", "radius_mm": 0.5}
WITNESS = {
    "side": "front", "box_mm": [10.0, 45.0, -13.0, -6.0], "depth_mm": 0.108, "visible_slope_rad": 1e-3,
    "wall_mm": 20.0,
    "marks": [
        {"share": share, "period_mm": 0.7, "periods": 8, "height_mm": 0.004} for share in (0.6, 0.8, 1.0, 1.25, 2.0)
    ],
}  # fmt: skip
FIGURES = REPORT["optics"] | {
    "converged": False, "branch": "inverted", "message": detail_lost(MILLED), "from_a_point_source": {"psnr_db": 44.0},
    "closing": CLOSING, "polish": POLISH, "tolerances": TOLERANCES, "concave_curvature_per_mm": CURVATURE,
    "min_concave_radius_mm": 0.5, "concave_radius_99_mm": 2.5, "dark_leak": 0.018, "dark_leak_estimate": 0.008,
    "min_radius_mm": 0.5, "against_original": {"psnr_db": 20.0, "ssim": 0.5},
}  # fmt: skip
EVERYTHING = REPORT | {
    "optics": FIGURES,
    "image": {"prepare": "detail", "prepared": True, "prepare_detail_mm": 0.5, "black_share": 0.1},
    "as_milled": MILLED,
    "as_finished": SEEN["as_finished"],
    "finishing": told() | {"minutes": 1000.0},
    "finish_tolerance": {
        "psnr_db": [24.0, 26.0, 20.0],
        "minutes_ratio": [0.8, 1.25],
        "within_ratio": [0.86, 1.08],
        "loss_db": 1.0,
    },
    "witness": WITNESS,
    "around": {"face": FACED, "witness": MARKS, "cut-out": CUT},
    "passes": [PASSED, LAST],
    "warnings": [detail_lost(MILLED)],
}
LAMP = {"kind": "point", "distance_mm": 400.0, "size_mm": 2.0, "gaussian_mm": 3.0}
MIRROR = SPEC["optics"] | {
    "surface": "mirror", "outline": "ellipse", "viewed_from": "behind", "light": LAMP, "throw_mm": 100.0,
    "screen_shift_x_mm": 20.0, "screen_shift_y_mm": -2.0,
}  # fmt: skip
AROUND = SPEC | {
    "optics": MIRROR,
    "stock": SPEC["stock"] | {
        "face": {"above_mm": 0.5, "radius_mm": 3.0},
        "cut_out": {"radius_mm": 0.25, "tabs": 2, "tab_height_mm": 0.3, "through_mm": 0.5},
        "clamps": [{"x_mm": 1.0, "y_mm": 1.0, "width_mm": 3.0, "depth_mm": 4.0}],
    },
    "machine": {
        "profile": "grbl", "dialect": "grbl", "safe_z_mm": 5.0, "coolant": "mist", "work_offset": 2,
        "blend_tolerance_mm": 0.01, "trace_outline": True, "warm_up_s": 30.0, "high_precision": "g08",
    },
}  # fmt: skip
FAILED = PROGRAM | {"ok": False, "faults": [detail_lost(MILLED)]}
JOBS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "everything": (EVERYTHING, AROUND),
    "plain": (REPORT, SPEC),
    "failed": ({"passes": [FAILED, PROGRAM], "source": {"file": "face.png"}}, SPEC),
    **{
        f"no marks by {obstacle}": ({"finishing": told(), "witness": {"obstacle": obstacle}}, SPEC)
        for obstacle in ("room", "steps", "noise", "slope")
    },
    "bare": ({}, {}),
    "designed": ({"optics": {"relief_mm": 3.0}}, SPEC | {"optics": SPEC["optics"] | {"light": {"kind": "sun"}}}),
}


@cache
def marked_sentences() -> dict[str, str]:
    keys = keys_of_the_page() | keys_of_the_server()
    return {key: BEGIN + PLACEHOLDER.sub(rf"{END}\g<0>{BEGIN}", key) + END for key in keys}


def said_past_the_tables(
    report: Mapping[str, Any], spec: Mapping[str, Any], monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    """Texts of the sheet that no table has, of a report that was read from a file."""
    monkeypatch.setattr(setup_sheet, "_read_table", lambda _language: marked_sentences())
    read = json.loads(json.dumps({"phrases": phrases_in(report), **report, "timings_s": {}, "versions": {}}))
    files = [*(picture.name for picture in PICTURES), "lens.stl"]
    page = render_page(describe_setup(read, spec=spec, files=files), "de").partition("<title>")[2]
    shown = re.sub(r"<style>.*?</style>|</?(?:strong|code|br)>", "", page, flags=re.DOTALL)
    texts = unescape(re.sub(r'<[^>]*?(?:aria-label="([^"]*)"[^>]*)?>', r"\n\1\n", shown))
    unmarked = re.sub(f"{BEGIN}[^{BEGIN}{END}]*({END}|$)", " ", texts)
    left = (NAMES.sub(" ", SAME.sub(" ", MAKERS.sub(" ", line))) for line in unmarked.splitlines())
    return [line for line in left if re.search("[A-Za-z]", line)]


@pytest.mark.parametrize("name", JOBS)
def test_nothing_is_said_past_the_tables(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert said_past_the_tables(*JOBS[name], monkeypatch) == []


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_page_says_its_language(language: str) -> None:
    page = render_page(describe_setup(REPORT, spec=SPEC), language)
    assert f'<html lang="{language}">' in page
    assert TABLES[language]["Before you press start"] in page and "Before you press start" not in page
    assert is_drawing(page_in(language))


def test_what_a_person_wrote_stays_although_it_reads_like_words_of_ours() -> None:
    page = render_page(describe_setup({"source": {"file": "lens.png"}}), "de")
    assert "Einrichteblatt: lens" in page and "Einrichteblatt: Linse" in render_page(describe_setup({}), "de")


def test_values_are_escaped_in_every_language() -> None:
    report = {"source": {"file": "<b>{0}</b>.png"}, "warnings": [Phrase("{note}", note="<i>{1}")]}
    for language in ("en", *LANGUAGES):
        page = render_page(describe_setup(report), language)
        assert "&lt;b&gt;{0}&lt;/b&gt;" in page and "&lt;i&gt;{1}" in page and "<i>" not in page
