"""A page says long before it happens that its code ends, and takes a new one without being loaded again."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from playwright.sync_api import Page, expect

from tests.page.browser import NOWHERE
from tests.page.conftest import Opened
from tests.page.machine_states import told

WARNING = ".toast"
LOOK = "async () => { await (await import('/page/lib/api.js')).api.hello(); }"
WHO = {"name": "Ada", "scopes": ["jobs:read", "jobs:write", "machine:run"], "anonymous": False, "paired": True}


def end_in(page: Page, minutes: float) -> None:
    """From now on the server says that the page's token ends then, and the page has asked."""
    ends = (datetime.now(UTC) + timedelta(minutes=minutes)).isoformat()
    page.route("**/v1/whoami", lambda route: route.fulfill(json=WHO | {"expires_at": ends}))
    page.evaluate(LOOK)


@pytest.mark.thorough
def test_a_code_that_ends_is_said_two_hours_before_and_again(opened: Opened) -> None:
    page = opened(NOWHERE, key="Ada", errors=("status of 401",))
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


@pytest.mark.thorough
@pytest.mark.parametrize("left", [60, -1])
def test_during_a_run_it_is_said_what_ends_with_the_code(opened: Opened, left: float) -> None:
    page = opened(NOWHERE, key="Ada")
    told(page, "running")
    end_in(page, left)
    when = "ends in 1 h" if left > 0 else "has ended"
    expect(page.locator(WARNING)).to_contain_text(
        f"The code on this page {when}, and pass-2-finish.nc is on shop. Enter a new one: without it this page can "
        "only HOLD and STOP."
    )
