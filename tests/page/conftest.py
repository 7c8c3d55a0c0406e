"""A browser and a stub of a server, as long as a process is at tests of the page; journeys have a real server.

`page` is one page, 1440 wide and light; `opened` makes others. Any error on a console fails the test that used it,
unless the test has said `watched.expect_errors(...)`; so does an answer that the server would never give.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect

from tests.page.answers import watched_answers
from tests.page.browser import ANSWER_MS, NOWHERE, SIZES, Scheme, Watched, missing, new_context, running_browser, shoot
from tests.page.stub import Stub, running_stub
from tests.service.conftest import _one_certificate  # noqa: F401 - journeys ask their server very often

Opened = Callable[..., Page]
# Contexts, programs and sizes are there as ever; to paint in software is two thirds of what a screen costs.
PAINT_NOTHING = """() => {
    for (const name of ["drawArrays", "drawArraysInstanced", "drawElements"])
        WebGL2RenderingContext.prototype[name] = () => {};
}"""
_loads = itertools.count()  # an address that differs by more than its view's is loaded, not only gone to

expect.set_options(timeout=ANSWER_MS)


@pytest.fixture(scope="package")
def launched() -> Iterator[tuple[Browser, asyncio.AbstractEventLoop]]:
    """Use `browser`."""
    if reason := missing():
        pytest.skip(reason)
    with running_browser() as found:
        loop = asyncio.get_running_loop()
        asyncio._set_running_loop(None)
        yield found, loop
        asyncio._set_running_loop(loop)


@pytest.fixture(scope="module")
def browser(launched: tuple[Browser, asyncio.AbstractEventLoop]) -> Iterator[Browser]:
    """The one of this process. Its driver's loop counts as running only meanwhile: other files may run theirs."""
    found, loop = launched
    asyncio._set_running_loop(loop)
    yield found
    asyncio._set_running_loop(None)


@pytest.fixture(scope="package")
def stub() -> Iterator[Stub]:
    """Where `opened` goes. Without a browser none is started."""
    if reason := missing():
        pytest.skip(reason)
    with running_stub() as found:
        yield found


@pytest.fixture(scope="package")
def kept(stub: Stub) -> Kept:
    """What a new page costs most is paid once: contexts by size, each with a page that `opened` loads anew."""
    return Kept(stub)


@pytest.fixture(autouse=True)
def answers() -> Iterator[None]:
    """Whatever a test tells its page, the server might."""
    with watched_answers() as lies:
        yield
    assert not lies, "\n".join(lies)


@pytest.fixture
def site(stub: Stub) -> str:
    """Where pages come from."""
    return stub.url


@pytest.fixture
def watched(browser: Browser, site: str) -> Iterator[Callable[..., Watched]]:
    """Makes browser contexts (size, scheme); at the end of the test none of their pages may have complained."""
    with contextlib.ExitStack() as stack:

        def make(size: str = "wide", scheme: Scheme = "light") -> Watched:
            context = new_context(browser, site, size=size, scheme=scheme)
            stack.callback(context.close)
            found = Watched(context)
            stack.callback(found.close)
            return found

        yield make


@pytest.fixture
def opened(browser: Browser, kept: Kept, stub: Stub) -> Iterator[Opened]:
    """opened("#/machines", size="phone", scheme="dark", key="Ada", errors=("status of 409",)), instead of the last.

    script: runs before the page's own, in a page that is used once; what a test does to the browser, not to what is
    loaded, takes one with `once` too.
    """
    with contextlib.ExitStack() as stack:

        def make(
            address: str = "#/",
            *,
            size: str = "wide",
            scheme: Scheme = "light",
            key: str = "",
            errors: tuple[str, ...] = (),
            script: str = "",
            once: bool = False,
        ) -> Page:
            stack.close()
            pages = kept.pages(browser, size, once=once or script != "")
            stack.callback(pages.rest)
            pages.expect_errors(*errors)
            page = pages.page()
            if script:
                page.add_init_script(script)
            width, height = SIZES[size]
            if page.viewport_size != {"width": width, "height": height}:
                page.set_viewport_size({"width": width, "height": height})
            page.emulate_media(color_scheme=scheme)
            visit(page, address, stub.key(key) if key else "")
            return page

        yield make
    assert not (lies := stub.lies()), "\n".join(lies)


@pytest.fixture
def open_unpainted(opened: Opened) -> Opened:
    """`opened`, for who looks at layout and words alone: WebGL draws nothing into its views."""

    def make(*address: str, **how: Any) -> Page:
        page = opened(*address, **how)
        page.evaluate(PAINT_NOTHING)
        return page

    return make


@pytest.fixture
def page(opened: Opened) -> Page:
    return opened()


@pytest.fixture
def modules(browser: Browser, kept: Kept) -> Page:
    """Where the page's modules can be imported, and nothing else goes on: for what has neither screen nor server."""
    return kept.context(browser, "wide").pages[0]


class Kept:
    """Contexts of the stub's pages, until the browser ends. The first page of each keeps the others' process."""

    def __init__(self, stub: Stub) -> None:
        self._stub = stub
        self._contexts: dict[str, BrowserContext] = {}
        self._pages: dict[str, Watched] = {}

    def context(self, browser: Browser, size: str) -> BrowserContext:
        touch = _touch_of(size)
        if touch not in self._contexts:
            self._contexts[touch] = new_context(browser, self._stub.url, size=touch)
            self._contexts[touch].new_page().goto("/page/icon.svg")
        return self._contexts[touch]

    def pages(self, browser: Browser, size: str, *, once: bool = False) -> Watched:
        """The page of this size that is loaded anew for each test, or one for this test only."""
        context, touch = self.context(browser, size), _touch_of(size)
        if once:
            if touch in self._pages:
                self._pages[touch].page().goto("about:blank")  # pages of one browser tell each other what they hear
            return Watched(context)
        return self._pages.setdefault(touch, Watched(context, stays=True))


def _touch_of(size: str) -> str:
    return "phone" if size == "phone" else "wide"


def visit(page: Page, address: str, token: str = "") -> None:
    """The page loaded anew; who has a token is known before the view of that address asks for anything."""
    page.goto(f"/?{next(_loads)}{NOWHERE if token else address}")
    if token:
        sign_in(page, token)
        page.evaluate("hash => { location.hash = hash }", address)


def sign_in(page: Page, token: str) -> None:
    """The page holds this token from now on, as if a person had given it: in its memory only."""
    page.evaluate("async (token) => { await (await import('/page/lib/api.js')).api.useToken(token); }", token)


@pytest.fixture
def picture(request: pytest.FixtureRequest) -> Callable[[Page, str], Path | None]:
    """Pictures of pages for a person to look at, where CAUSTICMILL_TRIAL_SHOTS names a folder."""
    folder = os.environ.get("CAUSTICMILL_TRIAL_SHOTS")

    def take(page: Page, name: str) -> Path | None:
        return shoot(page, Path(folder), name) if folder else None

    return take
