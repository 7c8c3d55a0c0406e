"""The tabs of one browser share one event stream, so that whatever else a person presses finds a free connection."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, Request, expect

from tests.page.browser import Watched
from tests.page.conftest import sign_in
from tests.page.driving import logged, machine_state
from tests.page.machine_states import NAME as MILL
from tests.page.stub import GOING, Stub
from tests.waiting import until

TABS = 6  # connections that a browser keeps to one server
EVENTS = "/events"
HIDE = """now => {
    Object.defineProperty(document, "hidden", {get: () => now, configurable: true});
    document.dispatchEvent(new Event("visibilitychange"));
}"""


class Tabs:
    """Pages of one browser. open: the requests for streams that are not over, with the page that made each."""

    def __init__(self, watched: Watched) -> None:
        self.watched = watched
        self.open: dict[Request, Page] = {}

    def add(self, address: str, token: str = "") -> Page:
        page = self.watched.page()
        page.on("request", lambda asked: self.open.update({asked: page}) if asked.url.endswith(EVENTS) else None)
        for over in ("requestfinished", "requestfailed"):
            page.on(over, lambda asked: self.open.pop(asked, None))
        page.on("close", lambda _: [self.open.pop(one) for one, its in list(self.open.items()) if its is page])
        page.goto("/")
        if token:
            sign_in(page, token)
        page.evaluate("hash => { location.hash = hash }", address)
        return page

    def leader(self, path: str) -> Page:
        """The one page that reads this stream."""
        pages = [page for asked, page in self.open.items() if path in asked.url]
        assert len(pages) == 1, len(pages)
        return pages[0]

    def await_streams(self, page: Page, count: int) -> None:
        until(lambda: (page.wait_for_timeout(50), len(self.open) == count)[1], what=f"{count} streams")
        page.wait_for_timeout(300)
        assert len(self.open) == count


@pytest.fixture
def tabs(watched: Callable[..., Watched]) -> Tabs:
    return Tabs(watched())


@pytest.mark.thorough
def test_six_tabs_with_a_job_leave_hold_free(tabs: Tabs, stub: Stub) -> None:
    pages = [tabs.add(f"#/jobs/{GOING}") for _ in range(TABS)]
    for page in pages:
        expect(page.get_by_role("heading", level=1)).to_be_visible()
    tabs.await_streams(pages[0], 1)
    mill = tabs.add(f"#/machines/{MILL}", stub.key("Ada"))
    expect(machine_state(mill)).not_to_have_text("asking the server")
    with logged(mill, "HOLD"):
        mill.get_by_role("button", name="HOLD").click()
    mill.get_by_role("button", name="STOP").click()
    tabs.await_streams(mill, 2)


@pytest.mark.thorough
def test_who_leads_may_close_or_hide_and_the_others_hear_on(tabs: Tabs, stub: Stub) -> None:
    address, token = f"#/machines/{MILL}", stub.key("Ada")
    path = f"/v1/machines/{MILL}/events"
    pages = [tabs.add(address, token) for _ in range(3)]
    for page in pages:
        expect(page.locator(".log li").first).to_be_visible()  # and what was before it came, too
    for leave in (lambda page: page.evaluate(HIDE, True), lambda page: page.close()):
        tabs.await_streams(pages[0], 1)
        first = tabs.leader(path)
        pages.remove(first)
        leave(first)
        tabs.await_streams(pages[0], 1)
        assert tabs.leader(path) is not first
        for page in pages:
            with logged(page, "HOLD"):
                pages[0].get_by_role("button", name="HOLD").click()
    pages[0].get_by_role("button", name="STOP").click()


def test_a_tab_that_nobody_sees_follows_nothing_and_comes_back(tabs: Tabs) -> None:
    page = tabs.add(f"#/jobs/{GOING}")
    tabs.await_streams(page, 1)
    page.evaluate(HIDE, True)
    tabs.await_streams(page, 0)
    page.evaluate(HIDE, False)
    tabs.await_streams(page, 1)


@pytest.mark.thorough
def test_only_tabs_with_the_same_token_share_and_it_stays_in_its_tab(tabs: Tabs, stub: Stub) -> None:
    tabs.watched.context.add_init_script("""
        window.said = [];
        const own = BroadcastChannel.prototype.postMessage;
        BroadcastChannel.prototype.postMessage = function (message) {
            window.said.push(this.name + JSON.stringify(message));
            return own.call(this, message);
        };
    """)
    address = f"#/machines/{MILL}"
    pages = [tabs.add(address, stub.key(name)) for name in ("Ada", "Ada", "Grace")]
    for page in pages:
        expect(page.locator(".log li").first).to_be_visible()
    tabs.await_streams(pages[0], 2)
    said = [text for page in pages for text in page.evaluate("window.said")]
    assert said
    assert not [text for text in said if stub.key("Ada") in text or stub.key("Grace") in text]
    sign_in(pages[2], stub.key("Ada"))  # from now on this one is Ada's, too
    tabs.await_streams(pages[0], 1)
