"""The setup sheet's figures of the check, and where the block may be held."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.job.report.block import CLAMP_MM, BlockSizes, top_view
from service.job.report.passes import check_rows, flutes_in_words, order_in_words
from service.job.report.setup_sheet import render_report
from service.job.spec.loading import resolve_spec
from service.job.spec.optics import ellipse_mm
from service.job.spec.tools import load_tools
from tests.service.job.report.test_setup_sheet import FILES, PROGRAM, REPORT, SPEC, Page

PASSED = PROGRAM | {
    "checked": "passed", "moves": 1234, "climb_share": 0.52, "slot_length_mm": 106.0, "slot_depth_mm": 1.5,
    "flute_need_mm": 3.21, "max_gap_mm": 0.5, "excess_um": 12.3, "pitch_mm": 0.5, "step_down_mm": 1.5,
    "radius_mm": 3.0,
}  # fmt: skip


def rows_of(*passes) -> dict[str, list[str]]:
    return {what: cells for what, _, cells in check_rows(passes)}


def test_every_figure_of_the_check_is_told():
    rows = rows_of(PASSED, PASSED | {"slot_length_mm": 0.1, "flute_length_mm": 12.0})
    cells = [cell for row in rows.values() for cell in row]
    for words in (
        "1.5 of 1.5 mm", "0.01 µm", "52 %", "106 mm, 1.5 mm deep", "nowhere", "not stated", "0.5 at 0.5 mm", "12.3 µm",
        "106 × 86 × 19.2 mm",
    ):  # fmt: skip
        assert words in cells, words
    assert rows["Shank and end of flutes against standing stock"] == ["not stated", "none"]


def test_what_was_not_checked_is_not_claimed():
    assert check_rows([{key: value for key, value in PASSED.items() if key != "checked"}]) == []
    failed = rows_of(PASSED | {"checked": "FAILED"})
    assert not any(cell == "none" for cells in failed.values() for cell in cells)
    assert "Places that a rest pass mills" not in failed


def test_rest_and_contour_passes_have_rows_of_their_own():
    rest = PASSED | {"rest": {"area_mm2": 66.42, "regions": 4}}
    contour = PASSED | {"contour": {"aligned_share": 0.981}}
    rows = rows_of(PASSED, rest, contour)
    assert rows["Places that a rest pass mills"] == ["–", "4 places, 66.4 mm²", "–"]
    assert rows["Along the contour lines (within 15°)"] == ["–", "–", "98 %"]


def test_tools_and_order_in_words():
    assert flutes_in_words({}) == "–"
    assert flutes_in_words({"flute_need_mm": 3.21}) == "3.3 mm"
    assert flutes_in_words({"flute_need_mm": 3.21, "flute_length_mm": 12.0}) == "3.3 mm (has 12)"
    assert order_in_words({"pitch_mm": 0.5, "direction": "y", "link": "retract"}) == "rows along Y, one way"
    assert "contour" in order_in_words({"strategy": "contour", "pitch_mm": 0.1})
    assert "only where" in order_in_words({"pitch_mm": 0.1, "where": "rest"})


@pytest.mark.parametrize(
    ("margin_mm", "clamped", "words"),
    [
        (14.0, True, "a ring 8 mm wide keeps the stock top: clamps stand there and nowhere else"),
        (8.0, False, "the ring around it is only 2 mm wide, and the cutters pass it down to Z −14.2 mm. Hold it from"),
        (6.0, False, "reaches the edge of the block: no clamp on top. Hold it from below"),
    ],
)
def test_clamps_go_where_no_cutter_goes_and_find_room(margin_mm, clamped, words):
    """The balls' flanks reach 6 mm beyond the lens. The sheet says one of two things, and the drawing the same."""
    spec = SPEC | {"stock": SPEC["stock"] | {"margin_mm": margin_mm}, "passes": [{"radius_mm": 3.0}] * 2}
    page = render_report(REPORT, spec=spec, files=FILES)
    text = Page(page).text
    assert "X −6 to 106, Y −6 to 86 mm" in text
    assert words in text
    assert ("no clamp on top" in text.lower()) != clamped
    assert ("clamps stand there" in text) == ('fill="url(#clamps)"' in page) == clamped
    assert clamped or "stock.margin_mm = 14 leaves a ring" in text


@pytest.mark.parametrize("preset", ["paper", "draft", "recommended"])
def test_the_default_margin_can_be_clamped(preset, monkeypatch, tmp_path):
    """Whatever ball of the shop's a plan comes to."""
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    spec = resolve_spec(preset=preset)
    radius_mm = max(one.radius_mm for one in spec.passes or load_tools())
    assert spec.stock.margin_mm - 2 * radius_mm >= CLAMP_MM


def test_where_the_top_is_faced_no_margin_is_promised_to_hold_clamps():
    stock = SPEC["stock"] | {"margin_mm": 14.0, "face": {"above_mm": 1.0, "tool": "flat"}}
    around = {
        "face": {"file": "pass-0-face.nc", "radius_mm": 3.0, "bounds": {"x": [-20, 120], "y": [-17, 97], "z": [0, 5]}}
    }
    text = Page(render_report(REPORT | {"around": around}, spec=SPEC | {"stock": stock}, files=FILES)).text
    assert "no clamp on top" in text and "leaves a ring" not in text
    assert "higher than 1 mm below the faced top" in text and "mm above the stock top, no clamp" not in text


def test_higher_clamps_ask_for_tools_that_stick_out_farther():
    """Where clamps stand, the holder passes over them; where none can, it may come down to the block."""
    for margin_mm, highest_mm, stick_out_mm in ((14.0, 11, 25.2), (8.0, 2, 16.2)):
        spec = SPEC | {"stock": SPEC["stock"] | {"margin_mm": margin_mm}, "passes": [{"radius_mm": 3.0}] * 2}
        text = Page(render_report(REPORT, spec=spec | {"machine": {"safe_z_mm": 12.0}}, files=FILES)).text
        assert f"higher than {highest_mm} mm above the stock top" in text
        assert f"{stick_out_mm:g} mm" in text


def test_clamps_of_the_spec_are_drawn_where_they_stand():
    clamp = {"x_mm": -12.0, "y_mm": 60.0, "width_mm": 10.0, "depth_mm": 20.0, "height_mm": 4.0}
    bare = render_report(REPORT, spec=SPEC, files=FILES)
    page = render_report(REPORT, spec=SPEC | {"stock": SPEC["stock"] | {"clamps": [clamp]}}, files=FILES)
    (box,) = set(re.findall(r"<rect [^>]+>", page)) - set(re.findall(r"<rect [^>]+>", bare))
    scale, zero_x, zero_y = _scale_of(page)
    corner = [float(re.search(rf'{name}="(-?[\d.]+)"', box)[1]) for name in ("x", "y")]
    assert corner == pytest.approx([zero_x - 12 * scale, zero_y - 80 * scale], abs=0.2)
    assert "checked against them" in page


def _scale_of(page: str) -> tuple[float, float, float]:
    """Pixels per mm of the top view, and where it has the work zero."""
    block = re.search(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"', page)
    left, top, wide, high = map(float, block.groups())
    stock, optics = SPEC["stock"], SPEC["optics"]
    scale = wide / (optics["width_mm"] + 2 * stock["margin_mm"])
    return scale, left + stock["margin_mm"] * scale, top + high - stock["margin_mm"] * scale


@given(width_mm=st.floats(5, 200), height_mm=st.floats(5, 200), margin_mm=st.floats(0, 30))
def test_the_top_view_draws_the_outline_inside_the_block(width_mm, height_mm, margin_mm):
    """To scale, and the right way up: seen from above with the front of the mill at the bottom."""
    corners = [(0, 0), (width_mm, 0), (0.5 * width_mm, height_mm)]
    job = BlockSizes(
        width_mm=width_mm,
        height_mm=height_mm,
        thickness_mm=10,
        margin_mm=margin_mm,
        throw_mm=100,
        outline_mm=corners,
    )
    drawing = str(top_view(job))
    points = [tuple(map(float, pair.split(","))) for pair in re.search(r'points="([^"]+)"', drawing)[1].split()]
    left, top, wide, high = (
        float(re.search(rf'<rect [^>]*?{name}="(-?[\d.]+)"', drawing)[1]) for name in ("x", "y", "width", "height")
    )
    scale = max(wide, high) / (max(width_mm, height_mm) + 2 * margin_mm)
    assert all(left - 0.1 <= x <= left + wide + 0.1 and top - 0.1 <= y <= top + high + 0.1 for x, y in points)
    assert points[1][0] - points[0][0] == pytest.approx(scale * width_mm, abs=0.2)
    assert points[0][1] - points[2][1] == pytest.approx(scale * height_mm, abs=0.2)


def test_a_round_lens_is_drawn_round():
    spec = SPEC | {"optics": SPEC["optics"] | {"outline": "ellipse"}}
    page = render_report(REPORT, spec=spec, files=FILES)
    assert len(re.search(r'points="([^"]+)"', page)[1].split()) == len(ellipse_mm(100.0, 80.0))
    assert "polygon" not in render_report(REPORT, spec=SPEC, files=FILES)
