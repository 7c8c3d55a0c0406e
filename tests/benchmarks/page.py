"""The page in a real browser: how soon it shows what it has, and how smoothly a hand moves five million points.

Peers: the same browser with an answer of the same server that it has only to print; and one canvas on which every point
of the same pass is drawn, as many as there are, from memory.
"""

from __future__ import annotations

import contextlib
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path

from playwright.sync_api import Browser, Page

from tests.benchmarks.timing import Figure
from tests.page.browser import Watched, missing, new_context, running_browser
from tests.page.drawn import NOTE_FIRST_PICTURE, drawn
from tests.page.paths import write_huge_path
from tests.page.shop import Shop, running_shop

VIEWS = 12
_PAINTED_MS = """() => new Promise((found) => {
    new PerformanceObserver((list) => {
        const [first] = list.getEntriesByName("first-contentful-paint");
        if (first) found(first.startTime);
    }).observe({type: "paint", buffered: true});
})"""
_HEADED_MS = """new MutationObserver(() => {
    if (document.querySelector("main h1")) window.headedAt ??= performance.now();
}).observe(document, {subtree: true, childList: true});"""
_EVERY_POINT_MS = """(points) => {
    const canvas = Object.assign(document.createElement("canvas"), {width: 800, height: 800});
    const rows = Math.round(Math.sqrt(points / 5));
    const along = Math.round(points / rows);
    const begun = performance.now();
    const context = canvas.getContext("2d");
    for (let row = 0; row < rows; row += 1) {
        const y = (800 * row) / rows;
        context.beginPath();
        for (let at = 0; at < along; at += 1) context.lineTo((800 * at) / along, y);
        context.stroke();
    }
    context.getImageData(0, 0, 1, 1);
    return performance.now() - begun;
}"""


def figures() -> Iterator[Figure]:
    if reason := missing():
        yield Figure("page", float("nan"), "", reason)
        return
    with (
        tempfile.TemporaryDirectory() as folder,
        running_browser() as browser,
        running_shop(Path(folder) / "shop") as shop,
    ):
        yield from _first_view(browser, shop)
        yield from _tool_path(browser, shop, Path(folder) / "huge.path")


def _first_view(browser: Browser, shop: Shop) -> Iterator[Figure]:
    own, bare = [], []
    for _ in range(VIEWS):
        with _page(browser, shop) as page:
            page.add_init_script(_HEADED_MS)
            page.goto("/")
            page.wait_for_function("window.headedAt")
            own.append(float(page.evaluate("window.headedAt")))
        with browser.new_context(base_url=shop.url) as context:
            page = context.new_page()
            page.goto("/livez")
            bare.append(float(page.evaluate(_PAINTED_MS)))
    note = f"to the heading of its list, each in a fresh context, median of {VIEWS}; slowest {max(own):.0f} ms"
    yield Figure("page: first view", statistics.median(own), "ms", note)
    yield Figure(
        "page: first view / first paint of a line of text", statistics.median(own) / statistics.median(bare), "x"
    )


def _tool_path(browser: Browser, shop: Shop, path: Path) -> Iterator[Figure]:
    points = write_huge_path(path)
    with _page(browser, shop) as page:
        view = drawn(lambda view, script: _at(page, f"/{view}", script), path, NOTE_FIRST_PICTURE)
        first_ms, sizes = view.first_picture_ms(), f"{points:,} points, {path.stat().st_size / 1e6:.0f} MB"
        yield Figure("page: first picture of a finish pass", first_ms, "ms", f"from the request; {sizes}")
        for steps, words in ((0, "whole"), (8, "zoomed in")):
            view.zoom(steps)
            view.at_rest()
            yield Figure(f"page: frames while the pass is dragged, {words}", view.drag(ms=2000), "1/s")
        every_ms = float(page.evaluate(_EVERY_POINT_MS, points))
        note = f"which would be moved at {1000 / every_ms:.1f} frames/s"
        yield Figure("page: first picture / every point on one canvas", first_ms / every_ms, "x", note)


@contextlib.contextmanager
def _page(browser: Browser, shop: Shop) -> Iterator[Page]:
    watched = Watched(new_context(browser, shop.url))
    try:
        yield watched.page()
    finally:
        watched.close()


def _at(page: Page, address: str, script: str) -> Page:
    page.add_init_script(script)
    page.goto(address)
    return page
