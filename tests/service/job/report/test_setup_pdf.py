"""The setup sheet on one page: complete, on the paper, and the same bytes for the same job."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pypdf import PageObject, PdfReader

from service.job.picture.light_png import picture_png
from service.job.report.figures.a4_sheet import HEIGHT, WIDTH, replace_missing, width_of, words_of, wrap
from service.job.report.setup_pdf import render_setup_pdf
from service.job.report.setup_sheet import describe_setup
from tests.service.job.report.sheet import render_report
from tests.service.job.report.test_setup_sheet import PROGRAM, REPORT, SPEC, Page

EDGE = 30.0  # white on each side of the paper
START = "do not leave it in the sun."  # the last thing to know before the start
NAMES = st.text(min_size=1, max_size=200)
PICTURE = picture_png(np.linspace(0, 1, 64 * 48).reshape(48, 64), white=1.0)


def sheet_of(report: dict[str, Any] = REPORT, spec: dict[str, Any] = SPEC, picture: bytes | None = PICTURE) -> bytes:
    return render_setup_pdf(describe_setup(report, spec=spec), picture)


def page_of(content: bytes) -> PageObject:
    [page] = PdfReader(io.BytesIO(content)).pages
    return page


def words(content: bytes) -> str:
    return " ".join(page_of(content).extract_text().split())


def program(number: int, name: str = "finish", **more: Any) -> dict[str, Any]:
    figures = {
        "radius_mm": 0.5 * number,
        "spindle_rpm": 10_000 + number,
        "feed_mm_per_min": 600,
        "plunge_mm_per_min": 90,
    }
    file = f"pass-{number}-{name}.nc"
    return PROGRAM | {"file": file, "sha256": f"{number:08x}" * 8, "settings": figures} | more


def places(content: bytes) -> list[tuple[float, float]]:
    """Return where each piece of text begins, from the lower left of the page."""
    found: list[tuple[float, float]] = []

    def see(text: str, place: list[float], within: list[float], *_: Any) -> None:
        if text.strip():
            found.append((place[4] + within[4] * place[0], place[5] + within[4] * place[1]))

    page_of(content).extract_text(visitor_text=see)
    return found


def test_it_is_one_page_of_a4_with_every_program_and_tool() -> None:
    rows = [program(number) for number in (1, 2, 3)]
    content = sheet_of(REPORT | {"passes": rows})
    box = page_of(content).mediabox
    assert (float(box.width), float(box.height)) == pytest.approx((595.28, 841.89), abs=0.1)
    text = words(content)
    for number in (1, 2, 3):
        tool = f"Ø {number} mm ball, R {0.5 * number:g} ≥ 16.2 mm"
        row = f"pass-{number}-finish.nc {tool} 10 00{number} 600, 90 13 h 53 min"
        assert f"{row} {number:08x}" in text, text
    assert "Setup sheet: face" in text
    assert len(page_of(content).images) == 1


def test_it_says_what_the_whole_sheet_says_in_the_same_words() -> None:
    pdf = words(sheet_of())
    page = Page(render_report(REPORT, spec=SPEC)).text
    for said in (
        "All 2 programs passed the check", "110 × 90 × 40 mm", "Nothing may stand higher than 2 mm above the stock top",
        "Set it again after each tool change", "Goggles and hearing protection on", START, "a ball of 1 mm diameter",
    ):  # fmt: skip
        assert said in page
        assert said in pdf, said
    assert "no clamp on top" in pdf  # in the drawing


def restarts(count: int) -> list[dict[str, Any]]:
    row = {"text": "X3.2Z-0.41", "at_mm": [-0.8, 3.125, -0.4], "is_rapid": False, "feed_mm_per_min": 900.0}
    more = {"kind": "row", "spindle_rpm": 9200.0, **row}
    lines = [{"line": 100 * k, "time_s": 600.0 * k, **more} for k in range(1, count)]
    return [{**lines[0], "line": 7, "kind": "layer", "is_rapid": True, "at_mm": [1.0, 2.0, 5.0]}, *lines]


def test_the_lines_to_go_on_from_after_a_break_stand_on_both() -> None:
    report = REPORT | {"restarts": {f"pass-{k}-finish.nc": restarts(12) for k in (1, 2)} | {"pass-3-short.nc": []}}
    page, pdf = Page(render_report(report, spec=SPEC)).text, words(sheet_of(report))
    for said in (
        "Where to go on after a break",
        "stream PROGRAM --recover",
        "X −0.8 Y 3.125",
        "G1 F900 S9200",
        "1 h 50 min",
    ):
        assert said in page and said in pdf, said
    assert page.count("X3.2Z-0.41") == 24 and page.count("a layer") == 2 and "G0 F900" in page
    assert START in pdf and all(x >= 0 and y >= 0 for x, y in places(sheet_of(report)))
    assert "after a break" not in Page(render_report(REPORT, spec=SPEC)).text + words(sheet_of())
    spec = SPEC | {"machine": {**SPEC.get("machine", {}), "units": "inch"}}
    assert "X −0.0315 Y 0.123" in Page(render_report(report, spec=spec)).text


@pytest.mark.thorough
def test_the_same_job_has_the_same_bytes_whatever_the_clock_says() -> None:
    other = REPORT | {"timings_s": {"lens": 99.0}, "peak_rss_mb": 1.0}
    assert sheet_of() == sheet_of(other)
    assert sheet_of() != sheet_of(REPORT | {"source": {"file": "other.png"}})


@pytest.mark.thorough
@settings(max_examples=6, deadline=None, phases=[Phase.explicit, Phase.generate])  # to shrink takes minutes
@given(NAMES, st.lists(NAMES, max_size=12), st.sampled_from([1, 3, 20]))
def test_whatever_it_has_to_say_stays_on_the_page(name: str, warnings: list[str], count: int) -> None:
    rows = [program(number, "a-name-twenty-four-long") for number in range(1, count + 1)]
    content = sheet_of(REPORT | {"passes": rows, "source": {"file": name}, "warnings": warnings * 3})
    assert all(EDGE < x < WIDTH - EDGE and EDGE < y < HEIGHT - EDGE for x, y in places(content))
    text = words(content)
    assert START in text
    assert all(row["file"] in text and row["sha256"][:8] in text for row in rows)


@pytest.mark.thorough
def test_warnings_give_way_to_what_must_be_known_and_say_so() -> None:
    warnings = [f"Warning {number}: " + "something long is said of the mill " * 6 for number in range(40)]
    text = words(sheet_of(REPORT | {"warnings": warnings}))
    assert "Warning 0:" in text and START in text
    assert "more on the setup sheet, report.html." in text


def test_what_was_said_of_the_picture_does_not_matter_at_the_mill() -> None:
    said = {
        "warnings": ["The picture is small.", "The feed is high."],
        "warnings_by_part": {"optics": ["The picture is small."]},
    }
    text = words(sheet_of(REPORT | said))
    assert "The feed is high." in text and "The picture is small." not in text


@pytest.mark.thorough
def test_a_mirror_says_so() -> None:
    text = words(sheet_of(spec=SPEC | {"optics": SPEC["optics"] | {"surface": "mirror"}}))
    assert "silvered or coated" in text and "from the wall's side" in text and "polished back" not in text


@pytest.mark.thorough
def test_a_round_lens_is_drawn_round() -> None:
    round_ = SPEC | {"optics": SPEC["optics"] | {"outline": "ellipse"}}
    assert "cut the block along the outline" in words(sheet_of(spec=round_))
    assert len(_curve_points(sheet_of(spec=round_))) > len(_curve_points(sheet_of())) + 20


def _curve_points(content: bytes) -> list[Any]:
    drawn = page_of(content).get_contents()
    assert drawn is not None
    return [one for one, operator in drawn.operations if operator == b"l"]


@pytest.mark.thorough
def test_a_program_in_parts_names_the_first_and_the_last() -> None:
    parts = [{"file": f"pass-1-rough-{k:02d}.nc", "sha256": f"{k}" * 64} for k in (1, 2, 3)]
    text = words(sheet_of(REPORT | {"passes": [program(1, parts=parts, file=parts[0]["file"])]}))
    assert "pass-1-rough-01.nc to pass-1-rough-03.nc" in text
    assert "11111111 … 33333333" in text


@pytest.mark.thorough
@pytest.mark.parametrize(
    "report", [{}, {"passes": []}, {"passes": [{}]}, {"passes": [{"file": "a.nc", "bounds": None}]}]
)
@pytest.mark.parametrize("spec", [{}, SPEC, {"optics": {"width_mm": 5.0}}])
def test_a_page_comes_out_of_every_unfinished_job(report: dict[str, Any], spec: dict[str, Any]) -> None:
    text = words(sheet_of(report, spec, None))
    assert "Setup sheet" in text and START in text
    assert "None" not in text


@given(st.lists(NAMES, min_size=20, max_size=40).map(" ".join), st.floats(5.0, 20.0))
@settings(max_examples=50, deadline=None)
def test_lines_are_no_wider_than_their_column_and_lose_nothing(text: str, size: float) -> None:
    plain = [(word, False) for word in text.split()]
    lines = list(wrap(plain, 200.0, size))
    assert all(width_of(" ".join(word for word, _ in line), False, size) <= 201.0 for line in lines)
    assert "".join(word for line in lines for word, _ in line) == "".join(word for word, _ in plain)


def test_what_is_strong_is_bold_with_its_full_stop() -> None:
    assert words_of("At <strong>Z &lt; 2</strong>, no <code>more</code>.") == [
        ("At", False), ("Z", True), ("<", True), ("2,", True), ("no", False), ("more.", False),
    ]  # fmt: skip


def test_a_letter_that_the_font_has_not_got_is_a_box() -> None:
    assert replace_missing("Ø 6 µm 顔") == "Ø 6 µm □"
