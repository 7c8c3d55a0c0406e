"""A tool path in the page, and the hand that moves it: for tests of what is drawn, and the benchmark of how fast."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from tests.page.browser import open_blank
from tests.page.conftest import Opened
from tests.page.jobs import answer, canned, like
from tests.page.paths import Served

NOTE_FIRST_PICTURE = """new MutationObserver(() => {
    if (document.querySelector("[data-level]")) window.drawnAt ??= performance.now();
}).observe(document, {subtree: true, childList: true, attributes: true});"""
_FIRST_PICTURE_MS = (
    """window.drawnAt - performance.getEntriesByType("resource").find(one => one.name.endsWith(".path")).startTime"""
)
_FRAMES = """ms => new Promise(done => {
    const all = []; let last = performance.now(); const end = last + ms;
    const step = now => { all.push(now - last); last = now; now < end ? requestAnimationFrame(step) : done(all); };
    requestAnimationFrame(step);
})"""


@dataclass(frozen=True, slots=True)
class Drawn:
    page: Page
    served: Served

    @property
    def frame(self) -> Locator:
        return self.page.locator(".path-frame")

    @property
    def level(self) -> Locator:
        return self.page.locator("[data-level]")

    def at_rest(self) -> None:
        """Nothing more is fetched or drawn for a while."""
        before = -1
        while before != len(self.served.fetched):
            before = len(self.served.fetched)
            self.page.wait_for_timeout(500)

    def picture(self) -> Image.Image:
        self.frame.evaluate("one => one.scrollIntoView({block: 'center'})")  # not under the page's bar
        return Image.open(io.BytesIO(self.frame.screenshot())).convert("RGB")

    def middle(self) -> tuple[float, float]:
        box = self.frame.bounding_box()
        assert box
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def zoom(self, steps: int) -> None:
        """By one turn of the wheel, which counts once the drawing has been clicked.

        Several turns might rest between two of them on a slow machine, and what is seen there would be fetched.
        """
        self.page.mouse.click(*self.middle())
        self.page.mouse.wheel(0, -400 * steps)

    def drag(self, *, ms: int) -> float:
        """About its place, by the mouse; frames per second meanwhile."""
        x, y = self.middle()
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.evaluate(f"window.frames_ = ({_FRAMES})({ms})")
        for step in range(ms // 25):
            self.page.mouse.move(x + 150 * np.sin(step / 9), y + 90 * np.sin(step / 7))
            self.page.wait_for_timeout(15)
        times: list[float] = self.page.evaluate("window.frames_")
        self.page.mouse.up()
        return 1000 * len(times) / sum(times)

    def first_picture_ms(self) -> float:
        """From the first request for its file to the first picture; NOTE_FIRST_PICTURE has to run before."""
        return float(self.page.evaluate(_FIRST_PICTURE_MS))


def drawn(opened: Opened, path: Path, before: str = "") -> Drawn:
    """The file, as a pass of the stub's job. before: a script that runs before the page's own."""
    job, files = canned()
    job = like(job, 20)
    url = f"/v1/jobs/{job['id']}/artifacts/pass-1.path"
    file = files[0] | {"name": "pass-1.path", "sha256": "f" * 64, "bytes": path.stat().st_size, "url": url}
    page = open_blank(opened, "job", script=before)
    found = Drawn(page, Served(path))
    found.served.on(page, url)
    answer(page, job, [file])
    page.evaluate("id => { location.hash = `#/jobs/${id}` }", job["id"])
    page.locator("#path-title").click()  # alone: no other part moves it
    expect(page.locator(".path-body")).to_be_visible()
    page.locator(".path-body").evaluate("one => one.scrollIntoView({block: 'center'})")
    expect(found.level).to_be_attached()
    return found
