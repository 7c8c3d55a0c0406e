"""A shop for whole ways through the page: a real server with its worker, a simulated mill and its agent.

As long as a process is at journeys. Every page has a context of its own, for there are several people here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Page

from tests.page.browser import Scheme, Watched, missing
from tests.page.conftest import Opened, visit
from tests.page.shop import Shop, running_shop


@pytest.fixture(scope="package")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shop]:
    """Its mill is called "shop". Without a browser none is started."""
    if reason := missing():
        pytest.skip(reason)
    with running_shop(tmp_path_factory.mktemp("shop"), "--with-simulated-mill") as found:
        yield found


@pytest.fixture
def site(shop: Shop) -> str:
    return shop.url


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
        visit(page, address, shop.key(key) if key else "")
        return page

    return make
