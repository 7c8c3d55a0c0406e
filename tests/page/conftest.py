"""A shop and a browser for the tests of the page. The shop lives as long as the session, the browser as long as a file:
while its driver lives, nothing else in the process can run an event loop of its own.

`page` is one page, 1440 wide and light; `opened` makes others. Any error on a console fails the test that used it,
unless the test has said `watched.expect_errors(...)`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.page.browser import ANSWER_MS, Scheme, Watched, missing, running_browser, shoot
from tests.page.shop import Shop, running_shop

Opened = Callable[..., Page]

expect.set_options(timeout=ANSWER_MS)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if reason := missing():
        pytest.skip(reason)
    with running_browser() as found:
        yield found


@pytest.fixture(scope="session")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shop]:
    """A real server, its worker, a simulated mill called "shop" and its agent. Without a browser none is started."""
    if reason := missing():
        pytest.skip(reason)
    with running_shop(tmp_path_factory.mktemp("shop"), "--with-simulated-mill") as found:
        yield found


@pytest.fixture
def watched(browser: Browser, shop: Shop) -> Iterator[Callable[..., Watched]]:
    """Makes browser contexts (size, scheme); at the end of the test none of their pages may have complained."""
    with contextlib.ExitStack() as stack:

        def make(size: str = "wide", scheme: Scheme = "light") -> Watched:
            found = Watched(browser, shop.url, size=size, scheme=scheme)
            stack.callback(found.close)
            return found

        yield make


@pytest.fixture
def opened(watched: Callable[..., Watched], shop: Shop) -> Opened:
    """opened("#/machines", size="phone", scheme="dark", key="Ada", errors=("status of 409",))."""

    def make(
        address: str = "#/",
        *,
        size: str = "wide",
        scheme: Scheme = "light",
        key: str = "",
        errors: tuple[str, ...] = (),
    ) -> Page:
        context = watched(size, scheme)
        context.expect_errors(*errors)
        page = context.page()
        page.goto("/")
        if key:
            sign_in(page, shop.key(key))
        page.evaluate("hash => { location.hash = hash }", address)
        return page

    return make


@pytest.fixture
def page(opened: Opened) -> Page:
    return opened()


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
