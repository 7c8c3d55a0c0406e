"""Mills of the shop: stated by what differs, and the job goes on with the one just stated."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page, Route, expect

from tests.page.canned_job import PROFILE_EXAMPLE
from tests.page.conftest import Opened
from tests.page.stub import PROFILES


def told(page: Page) -> list[tuple[str, Any]]:
    """What the server is told: (method, body) of each order."""
    orders: list[tuple[str, Any]] = []

    def answer(route: Route) -> None:
        method, name = route.request.method, route.request.url.rpartition("/")[2]
        body = route.request.post_data_json if method == "PUT" else None
        orders.append((f"{method} {name}", body))
        mine = [PROFILE_EXAMPLE | {"name": name, "mills": [], "built_in": False, "stated": body}] if body else []
        route.fulfill(json={"profiles": PROFILES + mine})

    page.route("**/v1/profiles/*", answer)
    return orders


def test_a_mill_is_stated_changed_and_taken_away_and_the_job_is_for_it(opened: Opened) -> None:
    page = opened("#/new")
    orders, mills = told(page), page.locator(".shop > details", has_text="Your mills")
    page.evaluate("import('/page/lib/api.js').then(({ api }) => (api.need = async () => true))")
    mills.locator("summary").click()
    expect(mills.get_by_label("Smallest step, µm")).to_have_attribute("placeholder", "4")
    mills.get_by_role("button", name="Keep this mill").click()
    expect(mills.get_by_role("alert")).to_have_text("It needs a name.")
    mills.get_by_label("Name").fill("cellar")
    mills.get_by_label("Smallest step, µm").fill("2.5")
    mills.get_by_label("Travel X, mm").fill("180")
    mills.get_by_role("button", name="Keep this mill").click()
    chosen = page.get_by_role("combobox", name="Machine").locator("option:checked")
    expect(chosen).to_contain_text("cellar")
    body = {"extends": "grbl", "travel_mm": [180, 300, 80], "step_mm": 0.0025}
    assert orders == [("PUT cellar", body)]
    mills.locator("summary").click()
    mills.get_by_role("button", name="cellar", exact=True).click()
    expect(mills.get_by_label("Travel Y, mm")).to_have_value("300")
    mills.get_by_role("button", name="Take away cellar").click()
    expect(chosen).not_to_contain_text("cellar")
    assert orders[1:] == [("DELETE cellar", None)]


def test_what_cannot_be_is_said_and_what_was_typed_stays(opened: Opened) -> None:
    page = opened("#/new", errors=("status of 422",))
    page.evaluate("import('/page/lib/api.js').then(({ api }) => (api.need = async () => true))")
    detail = "step_mm = 2: allowed: a number from 1e-06 to 1 mm"
    page.route("**/v1/profiles/*", lambda route: route.fulfill(status=422, json={"detail": detail, "field": "step_mm"}))
    mills = page.locator(".shop > details", has_text="Your mills")
    mills.locator("summary").click()
    mills.get_by_label("Name").fill("cellar")
    mills.get_by_label("Smallest step, µm").fill("2000")
    mills.get_by_role("button", name="Keep this mill").click()
    expect(mills.get_by_role("alert")).to_contain_text("allowed: a number from")
    step = mills.get_by_label("Smallest step, µm")
    expect(step).to_be_focused()
    expect(step).to_have_accessible_description("step_mm = 2: allowed: a number from 1e-06 to 1 mm.")
    expect(mills.locator("[aria-invalid=true]")).to_have_count(1)
    expect(mills.get_by_label("Name")).to_have_value("cellar")
