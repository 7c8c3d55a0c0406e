"""A page says long before it happens that its code ends, and takes a new one without being loaded again."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from playwright.sync_api import Page, expect

from tests.page.conftest import Opened
from tests.page.driving import take_control
from tests.page.machine_states import told
from tests.page.shop import MILL, Shop

WARNING = ".toast"
LOOK = "async () => { await (await import('/page/lib/api.js')).api.hello(); }"
WHO = {"name": "Ada", "scopes": ["jobs:read", "jobs:write", "machine:run"], "anonymous": False, "paired": True}


def end_in(page: Page, minutes: float) -> None:
    """From now on the server says that the page's token ends then, and the page has asked."""
    ends = (datetime.now(UTC) + timedelta(minutes=minutes)).isoformat()
    page.route("**/v1/whoami", lambda route: route.fulfill(json=WHO | {"expires_at": ends}))
    page.evaluate(LOOK)


def test_a_code_that_ends_is_said_two_hours_before_and_again(opened: Opened, shop: Shop) -> None:
    page = opened("#/machines", key="Ada", errors=("status of 401",))
    end_in(page, 125)
    warning = page.locator(WARNING)
    page.wait_for_timeout(300)
    expect(warning).to_have_count(0)
    end_in(page, 118)
    expect(warning).to_contain_text("The code on this page ends in 1 h 58 min.")
    page.get_by_role("button", name="Close").click()
    end_in(page, 100)
    page.wait_for_timeout(300)
    expect(warning).to_have_count(0)
    end_in(page, 25)
    expect(warning).to_contain_text("ends in 25 min")
    end_in(page, 24 * 60)  # renewed: a program runs
    expect(warning).to_have_count(0)


@pytest.mark.parametrize("left", [60, -1])
def test_during_a_run_it_is_said_what_ends_with_the_code(opened: Opened, left: float) -> None:
    page = opened("#/machines", key="Ada")
    told(page, "running")
    end_in(page, left)
    when = "ends in 1 h" if left > 0 else "has ended"
    expect(page.locator(WARNING)).to_contain_text(
        f"The code on this page {when}, and pass-2-finish.nc is on shop. Enter a new one: without it this page can "
        "only HOLD and STOP."
    )


def test_a_new_code_is_entered_without_loading_the_page_again(opened: Opened, shop: Shop) -> None:
    """Control of the mill stays."""
    page = opened(f"#/machines/{MILL}", key="Ada")
    take_control(page)
    page.evaluate("window.neverReloaded = true")
    end_in(page, 60)
    page.get_by_role("button", name="Enter a new code").click()
    page.unroute("**/v1/whoami")
    page.get_by_role("textbox", name="Code", exact=True).fill(shop.code)
    page.get_by_label("Your name").fill("Ada")
    page.get_by_role("button", name="Enter", exact=True).click()
    expect(page.locator(WARNING)).to_have_count(0)
    expect(page.get_by_role("dialog")).to_have_count(0)
    expect(page.get_by_text("You have control.")).to_be_visible()
    page.get_by_role("button", name="Give control back").click()
    expect(page.get_by_text("Nobody has control.")).to_be_visible()
    assert page.evaluate("window.neverReloaded")
