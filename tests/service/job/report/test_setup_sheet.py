"""The setup sheet: complete, safe against hostile names, and honest where something is missing; its figures of the
check, and where the block may be held.
"""

from __future__ import annotations

import itertools
import re
from html.parser import HTMLParser
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.envelope import CLAMP_GRIP_MM
from service.job.report.block import BlockSizes, side_view, top_view
from service.job.report.passes import check_rows, flutes_in_words, order_in_words
from service.job.spec.loading import resolve_spec
from service.job.spec.optics import ellipse_mm
from service.job.spec.tools import load_tools
from service.wording import describe_misplaced, duration, likeness_in_words, number, size, whole
from tests.service.job.report.sheet import render_report

SPEC = {
    "preset": "paper",
    "image": {"pixels": 512},
    "optics": {
        "width_mm": 100.0, "height_mm": 80.0, "throw_mm": 250.0, "refractive_index": 1.49,
        "method": "transport", "viewed_from": "lens",
    },
    "stock": {"thickness_mm": 40.0, "margin_mm": 5.0, "skim_mm": 0.1, "material": "pmma"},
    "machine": {"profile": "grbl"},
    "passes": [{"name": "rough", "radius_mm": 3.0, "pitch_mm": 0.5}, {"name": "finish", "radius_mm": 0.5}],
}  # fmt: skip
PROGRAM = {
    "file": "pass-1-rough.nc", "sha256": "ab" * 32, "lines": 1234567, "bytes": 20_000_000, "path_length_mm": 5e5,
    "time_s": 50_000.0, "entries": 1, "max_engagement_mm": 1.5, "gouge_um": 0.01,
    "bounds": {"x": [-3, 103], "y": [-3, 83], "z": [-14.2, 5.0]}, "ok": True,
}  # fmt: skip
REPORT = {
    "source": {"file": "face.png", "width": 512, "height": 410},
    "optics": {
        "psnr_db": 43.1, "ssim": 0.991, "misplaced_light": 0.003, "relief_mm": 14.1, "max_slope_deg": 20.0,
        "min_concave_radius_mm": None, "converged": True, "history": [],
    },
    "passes": [PROGRAM, PROGRAM | {"file": "pass-2-finish.nc"}],
    "timings_s": {"lens": 4.0}, "peak_rss_mb": 900.0, "versions": {"causticmill": "0.1.0"},
}  # fmt: skip
FILES = ["target.png", "caustic.png", "toolpath.png", "pass-1-rough.nc", "pass-2-finish.nc", "lens.stl"]

PASSED = PROGRAM | {
    "checked": "passed", "moves": 1234, "climb_share": 0.52, "slot_length_mm": 106.0, "slot_depth_mm": 1.5,
    "flute_need_mm": 3.21, "max_gap_mm": 0.5, "excess_um": 12.3, "pitch_mm": 0.5, "step_down_mm": 1.5,
    "radius_mm": 3.0,
}  # fmt: skip


class Page(HTMLParser):
    """Tags, attributes and text of a page; fails on tags that do not close."""

    VOID = frozenset({"meta", "img", "br", "link", "input"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        if "style" not in self._open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))

    @property
    def links(self) -> list[str]:
        return [value for _, attrs in self.tags for key, value in attrs.items() if key in ("href", "src")]


def test_the_page_says_what_the_operator_needs():
    text = Page(render_report(REPORT, spec=SPEC, files=FILES)).text
    for words in (
        "face.png", "110 × 90 × 40 mm", "250 mm from the stock top", "290 mm", "radius 3 mm", "diameter 6 mm",
        "diameter 1 mm", "13 h 53 min", "1 d 4 h", "16.2 mm", "43.1 dB", "about 7 dB", "(2.5 mm)", "ab" * 32, "passed",
        "on the lens's side",
    ):  # fmt: skip
        assert words in text, words


def test_the_page_needs_no_network_and_no_scripts():
    page = Page(render_report(REPORT, spec=SPEC, files=FILES))
    assert not {"script", "iframe", "link", "object"} & {tag for tag, _ in page.tags}
    assert sorted(page.links) == sorted(FILES)  # each file present is shown or linked once, and nothing else


def test_four_pictures_stand_two_by_two():
    walls = ["target.png", "caustic.png", "caustic-as-milled.png", "caustic-as-finished.png"]
    for files in (walls[:3], walls):
        first = next(
            classes
            for tag, attributes in Page(render_report(REPORT, files=files)).tags
            if tag == "div" and (classes := dict(attributes).get("class", "")).startswith("pair")
        )
        assert ("four" in first.split()) is (len(files) == 4)


def test_pictures_that_are_not_there_are_not_shown():
    page = Page(render_report(REPORT, spec=SPEC, files=["target.png"]))
    assert page.links == ["target.png"]


@pytest.mark.parametrize(
    "report",
    [
        {},
        {"optics": {"relief_mm": 3.0, "converged": False, "history": []}},
        {"passes": []},
        {"passes": [{}]},
        {"passes": [{"file": "a.nc", "bounds": None, "time_s": None}]},
        {"optics": {"psnr_db": None}, "versions": {}, "warnings": None, "as_milled": {}},
    ],
)
@pytest.mark.parametrize("spec", [None, {}, SPEC, {"optics": {"width_mm": 5.0}}])
def test_a_page_comes_out_of_every_unfinished_job(report, spec):
    text = Page(render_report(report, spec=spec)).text
    assert "Setup sheet" in text
    assert "None" not in text
    assert "passed the check" not in text


def test_the_verdict_follows_the_check():
    assert "All 2 programs passed" in Page(render_report(REPORT, spec=SPEC)).text
    failed = REPORT | {"passes": [PROGRAM, PROGRAM | {"file": "bad.nc", "ok": False, "faults": ["gouge of 3 µm"]}]}
    text = Page(render_report(failed, spec=SPEC)).text
    assert "Do not mill" in text
    assert "bad.nc: gouge of 3 µm" in text
    silent = REPORT | {"passes": [{key: value for key, value in PROGRAM.items() if key != "ok"}]}
    assert "No check is recorded" in Page(render_report(silent, spec=SPEC)).text


@settings(max_examples=30, deadline=None)
@given(st.text(min_size=1, max_size=40))
def test_no_name_can_put_markup_or_a_foreign_link_into_the_page(name):
    hostile = f"<script>alert(1)</script>\"'&{name}"
    report = REPORT | {
        "source": {"file": hostile},
        "warnings": [hostile],
        "passes": [PROGRAM | {"file": "javascript:alert(1)//" + hostile, "name": hostile, "faults": [hostile]}],
        "timings_s": {hostile: 1.0},
        "versions": {hostile: hostile},
    }
    spec = SPEC | {"machine": {"profile": hostile}, "stock": SPEC["stock"] | {"material": hostile}}
    files = [*FILES, report["passes"][0]["file"]]
    plain = Page(render_report(REPORT | {"passes": [PROGRAM]}, spec=SPEC, files=files))
    page = Page(render_report(report, spec=spec, files=files))
    assert "script" not in {tag for tag, _ in page.tags}
    assert {key for _, attrs in page.tags for key in attrs} == {key for _, attrs in plain.tags for key in attrs}
    assert not any(":" in link or link.startswith("//") for link in page.links)


def test_a_thin_cutter_that_has_to_reach_deep_is_named():
    text = Page(render_report(REPORT, spec=SPEC)).text
    assert "pass-2-finish.nc: a ball of 1 mm diameter has to reach 14.2 mm deep" in text
    assert "pass-1-rough.nc: a ball" not in text


def test_only_what_the_last_ball_cannot_reach_is_listed():
    first = PROGRAM | {"unreached": [{"x_mm": 1.0, "y_mm": 2.0, "excess_um": 9.0, "area_mm2": 1.0}]}
    last = PROGRAM | {"unreached": [{"x_mm": 31.25, "y_mm": 40.5, "excess_um": 3.14, "area_mm2": 0.02}]}
    text = Page(render_report(REPORT | {"passes": [first, last]}, spec=SPEC)).text
    assert "X 31.25 Y 40.5: 3.1 µm remain, over 0.02 mm²" in text
    assert "X 1 Y 2" not in text


def test_without_a_ring_left_at_the_stock_top_the_wall_is_measured_from_the_back():
    def page(margin_mm):
        return Page(render_report(REPORT, spec=SPEC | {"stock": SPEC["stock"] | {"margin_mm": margin_mm}})).text

    assert "ring around the lens stays at Z0" in page(6.5)
    assert "measure from the back" in page(5.0)  # the ball's flank reaches two radii beyond the lens: 6 mm


def test_words_for_numbers():
    assert [number(value, 2, "mm") for value in (1.0, -14.256, -0.001, None)] == ["1 mm", "−14.26 mm", "0 mm", "–"]
    assert number(100, 0) == "100"
    assert [duration(value) for value in (0, 59.4, 59.5, 420, 3600, 9900, 86_370, 183_600, None)] == [
        "0 s", "59 s", "1 min", "7 min", "1 h", "2 h 45 min", "1 d", "2 d 3 h", "–",
    ]  # fmt: skip
    assert [size(value) for value in (12, 1500, 2.5e6, 3e9, None)] == ["12 B", "1.5 kB", "2.5 MB", "3 GB", "–"]
    assert whole(1234567).split() == ["1", "234", "567"]
    assert [describe_misplaced(share) for share in (0, 1e-11, 0.0029)] == [
        "all light falls where it should",
        "all light falls where it should",
        "about 1 part in 345 of the light falls where it should not",
    ]
    assert len({likeness_in_words(seen_db) for seen_db in (100, 40, 30, 20, 10, 5)}) == 6


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.6, 0.9, 0.95])
def test_the_labels_beside_the_side_view_stand_apart(share):
    job = BlockSizes(width_mm=100, height_mm=100, thickness_mm=40, margin_mm=8, throw_mm=100, deepest_mm=40 * share)
    drawing = str(side_view(job))
    lines = [
        float(re.search(rf'<text x="[\d.]+" y="([\d.]+)"[^>]*>{words}', drawing)[1])
        for words in ("Z0 = stock top", "deepest", "flat, polished back")
    ]
    assert min(b - a for a, b in itertools.pairwise(lines)) >= 15  # of type 12.5 high


@pytest.mark.parametrize(("width_mm", "height_mm", "inside"), [(100, 100, True), (10, 10, False), (100, 20, False)])
def test_the_size_of_a_small_lens_stands_beside_the_block(width_mm, height_mm, inside):
    """Inside it would lie over the axes."""
    job = BlockSizes(width_mm=width_mm, height_mm=height_mm, thickness_mm=40, margin_mm=8, throw_mm=100)
    anchor = re.search(rf'text-anchor="(\w+)"[^>]*>{width_mm} × {height_mm} mm', str(top_view(job)))[1]
    assert (anchor == "middle") is inside


def sheet_of(*radii_mm: float, deepest_z_mm: float = -12.0, **spec: Any) -> str:
    bounds = {"x": [-3.0, 103.0], "y": [-3.0, 103.0], "z": [deepest_z_mm, 5.0]}
    rows = [PROGRAM | {"settings": {"radius_mm": radius}, "bounds": bounds} for radius in radii_mm]
    return Page(render_report(REPORT | {"passes": rows}, spec=SPEC | {"passes": []} | spec)).text


@pytest.mark.parametrize(
    ("radii_mm", "told"),
    [
        ((3.0, 3.0), "All passes use the same tool: it stays in, and Z0 is set once."),
        ((3.0, 0.5), "after each tool change, that is before pass 2."),
        ((3.0, 3.0, 0.5), "that is before pass 3; between the others the tool stays in and Z0 as it is."),
        ((3.0,), "the same for every pass."),
    ],
)
def test_z_is_set_again_after_a_tool_change_and_only_then(radii_mm: tuple[float, ...], told: str):
    text = sheet_of(*radii_mm)
    assert told in text
    assert text.count("tool change") == (len(set(radii_mm)) > 1)


@pytest.mark.parametrize(("safe_z_mm", "most"), [(5.0, "2 mm"), (2.5, "1.5 mm")])
def test_one_height_that_nothing_may_stand_above(safe_z_mm: float, most: str):
    """Holder and rapid moves both come over what clamps the block; the lower of them counts."""
    text = sheet_of(3.0, machine={"safe_z_mm": safe_z_mm})
    assert f"Nothing may stand higher than {most} above the stock top" in text
    assert "reach that high" not in text


def test_a_program_that_goes_below_the_lens_says_where_and_why():
    relief = REPORT["optics"]["relief_mm"] + SPEC["stock"].get("skim_mm", 0.0)
    assert "The programs go deeper, to Z −40 mm: beside the lens" in sheet_of(3.0, deepest_z_mm=-40.0)
    assert "The programs go deeper" not in sheet_of(3.0, deepest_z_mm=-relief)


def test_the_owner_of_an_osp_is_asked_to_try_what_we_only_guess():
    def text(dialect):
        machine = {"dialect": dialect, "top_z_mm": 455.0}
        return Page(render_report(REPORT, spec=SPEC | {"machine": machine})).text

    assert "We only guess that G16 H0 goes to machine Z455 while a tool length" in text("okuma")
    assert "G16" not in text("fanuc")


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
    assert spec.stock.margin_mm - 2 * radius_mm >= CLAMP_GRIP_MM


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
    clamp = {"x_mm": -6.0, "y_mm": 60.0, "width_mm": 10.0, "depth_mm": 20.0, "height_mm": 4.0}
    bare = render_report(REPORT, spec=SPEC, files=FILES)
    page = render_report(REPORT, spec=SPEC | {"stock": SPEC["stock"] | {"clamps": [clamp]}}, files=FILES)
    (box,) = set(re.findall(r"<rect [^>]+>", page)) - set(re.findall(r"<rect [^>]+>", bare))
    scale, zero_x, zero_y = _scale_of(page)
    corner = [float(re.search(rf'{name}="(-?[\d.]+)"', box)[1]) for name in ("x", "y")]
    assert corner == pytest.approx([zero_x - 6 * scale, zero_y - 80 * scale], abs=0.2)
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
