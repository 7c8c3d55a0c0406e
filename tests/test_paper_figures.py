"""`make paper` writes every figure it names, and its claims hold at a size that takes seconds."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.paper.__main__ import FIGURES, main
from tests.paper.cases import contrast_reached, edge_waviness_pixels, slanted_edge

DOCS = Path(__file__).parents[1] / "docs"


def pictures_of(page: Path) -> list[Path]:
    return [page.parent / name for name in re.findall(r"!\[.*?\]\((.*?)\)", page.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("moved", [0.0, 0.3, -1.4])
def test_a_straight_edge_is_not_wavy_wherever_it_lies(moved):
    """Waviness is the spread of the misses: an edge that is out of place by a constant has none."""
    shifted = np.apply_along_axis(lambda row: np.interp(np.arange(64) - moved, np.arange(64), row), 1, slanted_edge(64))
    assert edge_waviness_pixels(shifted) < 0.12  # what sampling at pixels leaves of an edge cut in straight pieces


def test_a_wavy_edge_is_measured():
    """Rows moved to and fro by a pixel: an rms of 1 / sqrt(2)."""
    rows = slanted_edge(128)
    waves = np.sin(0.7 * np.arange(128))
    wavy = np.stack([np.interp(np.arange(128) - w, np.arange(128), row) for row, w in zip(rows, waves, strict=True)])
    assert edge_waviness_pixels(wavy) == pytest.approx(np.sqrt(0.5), abs=0.1)


def test_contrast_is_the_slope_against_the_target():
    """A picture with a share of its contrast, and noise that has none of it, has that share."""
    wanted = slanted_edge(64)
    noise = np.random.default_rng(3).normal(0.0, 0.05, wanted.shape)
    assert contrast_reached(1.0 + 0.4 * (wanted - 1.0) + noise, wanted) == pytest.approx(0.4, abs=0.01)


def test_the_page_in_docs_has_its_pictures():
    """Small enough for a repository, and none that the page does not show."""
    shown = pictures_of(DOCS / "paper.md")
    assert sorted(shown) == sorted((DOCS / "paper").iterdir())
    assert sum(picture.stat().st_size for picture in shown) < 3_000_000


@pytest.mark.thorough
def test_make_paper_at_a_small_size(tmp_path):
    small = {"--pixels": "32", "--steps-pixels": "32", "--remeshed-pixels": "32", "--milled-mm": "4"}
    main([*(word for pair in small.items() for word in pair), "--output", str(tmp_path)])
    page = tmp_path / "paper.md"
    for picture in pictures_of(page):
        assert np.ptp(np.asarray(Image.open(picture).convert("L"))) > 200  # drawn, not blank
    text = page.read_text(encoding="utf-8")
    assert len(pictures_of(page)) == len(FIGURES)
    assert not re.search(r"\b(nan|inf)\b", text)
    for number in (4, 5, 6, 7, 8, 9, 12, 13, 14, 15):
        assert re.search(rf"^\| {number} \| .+ \| .+ \|$", text, flags=re.MULTILINE), f"no line on figure {number}"
