"""The code that the server has printed, given to a page."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from tests.page.conftest import Opened
from tests.page.driving import take_control
from tests.page.shop import MILL, Shop
from tests.page.test_key_end import WARNING, end_in


@pytest.mark.thorough
def test_the_code_of_the_terminal_gives_the_key_and_the_key_stays_in_memory(opened: Opened, shop: Shop) -> None:
    page = opened(errors=("status of 40[0-9]", "status of 422"))
    page.get_by_role("button", name="Enter code").click()
    dialog = page.get_by_role("dialog", name="Enter the code")
    dialog.get_by_label("Your name").fill("Grace")
    expect(dialog.get_by_text("causticmill token pair")).to_be_hidden()
    dialog.get_by_text("No code at hand?").click()
    expect(dialog.get_by_text("causticmill token pair")).to_be_visible()
    dialog.get_by_role("textbox", name="Code", exact=True).fill("no code")
    dialog.get_by_role("button", name="Enter", exact=True).click()
    expect(dialog.get_by_role("alert")).to_contain_text("twelve letters and digits")
    assert not re.search(r"\bkey\b", page.locator("body").inner_text(), re.I), "one word for one thing"
    dialog.get_by_role("textbox", name="Code", exact=True).fill("0000-0000-0000")
    dialog.get_by_role("button", name="Enter", exact=True).click()
    expect(dialog.get_by_role("alert")).to_contain_text("This is not the code")
    dialog.get_by_role("textbox", name="Code", exact=True).fill(shop.code.lower().replace("-", " "))
    expect(dialog.get_by_role("textbox", name="Code", exact=True)).to_have_value(shop.code)
    dialog.get_by_role("button", name="Enter", exact=True).click()
    expect(page.get_by_role("button", name="Grace")).to_be_visible()
    token = page.evaluate("import('/page/lib/api.js').then(({api}) => api.token)")
    assert token
    kept = page.evaluate("[localStorage, sessionStorage].map(one => JSON.stringify(one)).join() + document.cookie")
    assert token not in kept + page.url and not page.context.cookies()
    page.get_by_role("button", name="Grace").click()
    page.get_by_role("button", name="Keep it").click()
    expect(page.get_by_role("button", name="Grace")).to_be_visible()
    page.reload()
    expect(page.get_by_role("button", name="Enter code")).to_be_visible()


@pytest.mark.thorough
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
