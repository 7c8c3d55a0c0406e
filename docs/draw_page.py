"""Takes the pictures of docs/page.md: the real page of a real server with a simulated mill, driven by the test browser.

make docs-pictures, or python -m docs.draw_page docs/page
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, expect

from tests.page.browser import ANSWER_MS, Scheme, new_context, running_browser
from tests.page.conftest import visit
from tests.page.driving import load, start, take_control, zeroed
from tests.page.shop import MILL, Shop, running_shop

PICTURE = Path(__file__).parents[1] / "examples" / "camera.png"
WIDTH, MOST_BYTES = 1200, 100_000
JOB_MS = 30 * 60_000  # a lens with its finish, on a slow computer that has other work


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    expect.set_options(timeout=ANSWER_MS)
    with tempfile.TemporaryDirectory() as data, running_shop(Path(data)) as shop, running_browser() as browser:
        page = _open(browser, shop, scheme="dark")
        page.wait_for_timeout(8000)  # the wall comes into focus
        _take(page, folder / "start.webp")

        page = _open(browser, shop, "#/new")
        _choose(page)
        _take(page, folder / "new.webp")
        page.get_by_role("button", name="Make the lens").click()
        send = page.get_by_role("link", name="pass-1-rough.nc").first
        expect(send).to_be_visible(timeout=JOB_MS)
        job = page.url.rpartition("/")[2]
        shop.succeeded(job)
        page = _open(browser, shop, f"#/jobs/{job}")
        page.wait_for_timeout(4000)  # its pictures are drawn
        _take(page, folder / "job.webp")

        page = _open(browser, shop, f"#/machines/{MILL}")
        take_control(page)
        _take(page, folder / "control.webp")
        zeroed(page)
        load(page, job, "pass-1-rough.nc")
        _take(page, folder / "checks.webp")
        start(page)
        page.wait_for_timeout(15_000)  # some of the part is cut
        _take(page, folder / "running.webp")
        phone = _open(browser, shop, f"#/machines/{MILL}", size="phone")
        phone.wait_for_timeout(3000)
        _take(phone, folder / "phone.webp", width=390)


def _open(browser: Browser, shop: Shop, address: str = "#/", *, size: str = "wide", scheme: Scheme = "light") -> Page:
    page = new_context(browser, shop.url, size=size, scheme=scheme).new_page()
    visit(page, address, shop.key("Ada") if address != "#/" else "")
    return page


def _choose(page: Page) -> None:
    """Choose a small lens, so that it is made within minutes; wait until the estimate is exact."""
    with page.expect_response(lambda answer: "exactly=true" in answer.url and answer.ok, timeout=JOB_MS):
        page.locator("input[type=file]").first.set_input_files(PICTURE)
        for label, value in (("Width", "60"), ("Height", "60"), ("Distance to the wall", "200")):
            page.get_by_label(label, exact=True).fill(value)
    page.wait_for_timeout(1500)


def _take(page: Page, file: Path, *, width: int = WIDTH) -> None:
    """Write a picture of the window, from the top of the page, in the best quality that the size limit allows."""
    page.evaluate("() => { document.activeElement?.blur(); scrollTo(0, 0); }")
    shown = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    shown = shown.resize((width, round(shown.height * width / shown.width)), Image.Resampling.LANCZOS)
    for quality in range(88, 20, -8):
        shown.save(file, quality=quality, method=6)
        if file.stat().st_size <= MOST_BYTES:
            return
    raise ValueError(f"{file}: more than {MOST_BYTES} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
