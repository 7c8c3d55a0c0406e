"""Tool paths drawn: a glance needs little of the file, a closer look what it shows, and a hand is followed at once."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

from tests.page.conftest import Opened
from tests.page.drawn import Drawn, drawn
from tests.page.paths import FEED_MM_PER_S, SIDE_MM, Thinned, write_huge_path, write_path
from tests.page.test_job import NO_WEBGL
from tests.service.job.page_data.paths import split_header

PITCH_MM = 0.05
SMALL = (Thinned(8, 0.2, 0.4), Thinned(2, 0.04, 0.1), Thinned(1, 0.01, 0.0))
GLANCE_BYTES = 700_000


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("paths") / "small.path"
    assert write_path(path, side_mm=SIDE_MM, pitch_mm=PITCH_MM, levels=SMALL) > 200_000
    return path


@pytest.fixture
def view(opened: Opened, small: Path) -> Iterator[Drawn]:
    found = drawn(opened, small)
    found.at_rest()
    yield found


def shares(picture: Image.Image) -> tuple[float, float]:
    """Of the middle and of the left edge, what is not the colour of the ground, as it is near the corner."""
    pixels = np.asarray(picture, dtype=int)
    other = np.abs(pixels - pixels[12, 12]).sum(axis=2) > 30
    height, width = other.shape
    middle = other[height // 3 : -height // 3, width // 2 - height // 5 : width // 2 + height // 5]
    return float(middle.mean()), float(other[10 : height // 2, 10 : width // 20].mean())


def test_the_whole_pass_is_drawn_from_the_beginning_of_the_file(view: Drawn) -> None:
    """The lens's place is full of lines, what lies beside it is empty; the rest of the file was not asked for."""
    inside, beside = shares(view.picture())
    assert inside > 0.15
    assert beside == 0.0
    assert view.served.fetched[0][0] == 0
    assert view.served.fetched[0][1] <= GLANCE_BYTES


@pytest.mark.thorough
def test_a_closer_look_fetches_what_it_shows_and_shows_every_move(view: Drawn) -> None:
    """How close that is depends on how fast the browser draws."""
    view.zoom(9)
    view.at_rest()
    for _ in range(12):
        if view.page.locator(".path-note").text_content() == "Every move is drawn.":
            break
        view.zoom(1)
        view.at_rest()
    expect(view.page.locator(".path-note")).to_have_text("Every move is drawn.")
    whole = split_header(view.served.path.read_bytes())[0]["levels"][-1]
    taken = sum(max(0, end - max(start, whole["offset_bytes"])) for start, end in view.served.fetched[1:])
    assert 0 < taken < 0.3 * 8 * whole["points"]
    view.page.get_by_role("button", name="Whole lens").click()
    expect(view.page.locator(".path-note")).not_to_have_text("Every move is drawn.")


@pytest.mark.thorough
def test_a_drag_moves_what_is_drawn_at_once_and_fetches_when_it_rests(view: Drawn) -> None:
    view.zoom(6)
    view.at_rest()
    x, y = view.middle()
    fetched = len(view.served.fetched)
    lens = view.page.locator(".path-lens")
    before = lens.get_attribute("points") or ""
    view.page.mouse.move(x, y)
    view.page.mouse.down()
    for step in range(1, 11):
        view.page.mouse.move(x + 6 * step, y - 4 * step)
    after = lens.get_attribute("points") or ""
    assert len(view.served.fetched) == fetched
    first, second = ([float(number) for number in points.split()[0].split(",")] for points in (before, after))
    assert second[0] - first[0] == pytest.approx(60, abs=0.3)
    assert second[1] - first[1] == pytest.approx(-40, abs=0.3)
    view.page.mouse.up()
    view.frame.press("0")
    view.at_rest()
    assert shares(view.picture())[0] > 0.15


@pytest.mark.thorough
def test_time_goes_to_where_the_tool_is_then(view: Drawn) -> None:
    """At half of the time the tool is on the middle row, and only what lies before it is drawn as cut."""
    slider = view.page.get_by_role("slider", name="Time in the pass")
    slider.focus()
    slider.evaluate("one => { one.value = 2500; one.dispatchEvent(new Event('input', {bubbles: true})); }")
    told = re.search(
        r"X ([\d.-]+)\s+Y ([\d.-]+)\s+Z (-[\d.]+)\s+line (\d+)", view.page.locator(".path-place").inner_text()
    )
    assert told
    x_mm, y_mm, z_mm, line = map(float, told.groups())
    rows = round(SIDE_MM / PITCH_MM) + 1
    row = 0.25 * rows
    assert y_mm == pytest.approx(row * PITCH_MM, abs=9 * PITCH_MM)  # to a row of the level that is drawn
    assert z_mm == pytest.approx(-1 - 0.9 * np.sin(6.3 * x_mm / SIDE_MM) * np.cos(5 * y_mm / SIDE_MM), abs=0.02)
    assert line == pytest.approx(0.25 * rows * 1001, rel=0.06)
    expect(slider).to_have_attribute("aria-valuetext", re.compile(" of "))
    assert rows * SIDE_MM / FEED_MM_PER_S > 60
    view.at_rest()
    pixels = np.asarray(view.picture(), dtype=int)
    blue = pixels[:, :, 2] - pixels[:, :, 0] > 40
    height, width = blue.shape
    band = blue[:, width // 2 - height // 5 : width // 2 + height // 5].mean(axis=1)
    assert band[int(0.78 * height) : int(0.94 * height)].mean() > 10 * max(1e-3, band[: int(0.6 * height)].mean())


@pytest.mark.thorough
def test_keys_move_zoom_and_return(view: Drawn) -> None:
    lens = view.page.locator(".path-lens")
    start = lens.get_attribute("points")
    view.frame.focus()
    for key in ("ArrowRight", "+", "+", "ArrowUp", "-"):
        before = lens.get_attribute("points")
        view.frame.press(key)
        assert lens.get_attribute("points") != before
    view.frame.press("0")
    assert lens.get_attribute("points") == start


@pytest.mark.thorough
def test_the_page_scrolls_past_a_drawing_that_nobody_has_touched(view: Drawn) -> None:
    lens = view.page.locator(".path-lens")
    before = lens.get_attribute("points")
    view.page.mouse.move(*view.middle())
    view.page.mouse.wheel(0, -300)
    view.page.wait_for_timeout(200)
    assert lens.get_attribute("points") == before


@pytest.mark.thorough
def test_without_webgl_the_path_is_drawn_all_the_same(opened: Opened, small: Path) -> None:
    view = drawn(opened, small, NO_WEBGL)
    view.at_rest()
    inside, beside = shares(view.picture())
    assert inside > 0.15
    assert beside == 0.0


@pytest.mark.thorough
def test_five_million_points_are_seen_from_a_glance_at_the_file(opened: Opened, tmp_path: Path) -> None:
    """How soon that is, and how smooth a hand moves it, is for the benchmark of the page."""
    path = tmp_path / "huge.path"
    assert write_huge_path(path) > 5_000_000
    view = drawn(opened, path)
    assert view.served.fetched[0][1] <= GLANCE_BYTES
    for steps in (0, 8):
        view.zoom(steps)
        view.at_rest()
        fetched = view.served.bytes
        view.drag(ms=500)
        assert view.served.bytes - fetched <= GLANCE_BYTES
    assert view.served.bytes < path.stat().st_size / 4
