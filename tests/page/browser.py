"""A real browser in tests, driven by playwright; what it complains of fails the test.

Debian's chromium: its headless shell, where it is there, takes half the time.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from axe_playwright_python.base import AXE_SCRIPT
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, sync_playwright

ANSWER_MS = 120_000.0  # a page that answers at all does so sooner; jobs are waited for with JOB_MS
SIZES = {"wide": (1440, 900), "tablet": (1024, 768), "phone": (390, 844)}
NOWHERE = "#/-"  # an address of no view
TOUCH_PX = 44  # that a finger in a glove hits
SERIOUS = ("serious", "critical")
_LAYOUT = Path(__file__).with_name("layout.js").read_text()
_NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--process-per-site",  # pages of one context share a process
    "--use-fake-device-for-media-stream",  # a camera that sees a test picture
    "--use-fake-ui-for-media-stream",
)

Scheme = Literal["light", "dark"]


def missing() -> str:
    """Why there can be no browser here, in one line; "" where there can."""
    return "" if _program() else f"no browser here: none of {', '.join(_NAMES)} is in the PATH"


@contextmanager
def running_browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_program(), args=list(_FLAGS))
        try:
            yield browser
        finally:
            browser.close()


class Watched:
    """Pages of a context. `complaints`: errors on their consoles, but those a test has said it expects.

    stays: there is one page, which the next test loads anew; what the last one's still says then is nobody's.
    """

    def __init__(self, context: BrowserContext, *, stays: bool = False) -> None:
        self.context = context
        self.complaints: list[str] = []
        self._stays = stays
        self._rests = False
        self._pages: list[Page] = []
        self._expected: list[re.Pattern[str]] = []

    def page(self) -> Page:
        if self._stays and self._pages:
            return self._pages[0]
        page = self.context.new_page()
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self._complain(f"uncaught: {error}"))
        page.on("domcontentloaded", lambda _: setattr(self, "_rests", False))
        self._pages.append(page)
        return page

    def expect_errors(self, *patterns: str) -> None:
        """Errors that are part of what is tested, such as a refused connection."""
        self._expected += map(re.compile, patterns)

    def close(self) -> None:
        """AssertionError with whatever the pages complained of."""
        while self._pages:
            self._pages.pop().close()
        self._judge()

    def rest(self) -> None:
        """The end of a test: `close`, but a page that stays is only given back as it was got."""
        self.context.clear_permissions()
        if not self._stays:
            self.close()
            return
        self._rests = True  # what it asks from now on, nobody answers
        for page in self._pages:
            page.unroute_all(behavior="ignoreErrors")
        self._judge()

    def _judge(self) -> None:
        unexpected = [one for one in self.complaints if not any(known.search(one) for known in self._expected)]
        self.complaints, self._expected = [], []
        assert not unexpected, "\n".join(unexpected)

    def _complain(self, words: str) -> None:
        if not self._rests:
            self.complaints.append(words)

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            where = message.location.get("url", "")
            self._complain(f"{message.text} ({where})")


def new_context(browser: Browser, base_url: str, *, size: str = "wide", scheme: Scheme = "light") -> BrowserContext:
    width, height = SIZES[size]
    found = browser.new_context(
        base_url=base_url,
        viewport={"width": width, "height": height},
        color_scheme=scheme,
        reduced_motion="reduce",
        has_touch=size == "phone",
    )
    found.set_default_timeout(ANSWER_MS)
    return found


def open_blank(opened: Callable[..., Page], view: str, **how: Any) -> Page:
    """A page that shows nothing yet and asks for nothing; the files of this view ("machine") are there already.

    For who tells the page what it hears before it looks: from then on the browser keeps no files.
    """
    page = opened(NOWHERE, **how)
    page.evaluate(
        """async (view) => {
            const [{ sheet }] = await Promise.all([import("/page/lib/dom.js"), import(`/page/${view}/view.js`)]);
            await sheet(`/page/${view}/${view}.css`);
        }""",
        view,
    )
    return page


def serious_faults(page: Page) -> list[str]:
    """What axe-core finds serious or critical on the page as it is now, a sentence for each element."""
    if not page.evaluate("typeof window.axe === 'object'"):
        page.evaluate(AXE_SCRIPT)
    found: dict[str, Any] = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    return [
        f"{fault['id']}: {fault['help']}: {node['html'][:160]} {' '.join(node.get('failureSummary', '').split())[:200]}"
        for fault in found["violations"]
        if fault["impact"] in SERIOUS
        for node in fault["nodes"]
    ]


def layout_faults(page: Page, *, least_px: int = TOUCH_PX) -> list[str]:
    """What breaks the laws of layout.js on the page as it is now, a sentence for each fault.

    What is drawn anew for a size is there after the next frame, not before.
    """
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    found: list[str] = page.evaluate(_LAYOUT, {"least": least_px})
    return found


def shoot(page: Page, folder: Path, name: str) -> Path:
    """A picture of the whole page."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    page.screenshot(path=path, full_page=True)
    return path


def _program() -> str | None:
    return next((found for name in _NAMES if (found := shutil.which(name))), None)
