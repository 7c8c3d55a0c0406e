"""The cutters that the shop has: by diameter, kept on the server, and the plan is told anew with them."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page, Route, expect

from tests.page.conftest import Opened
from tests.page.stub import TOOLS

CORNERS = {None: "", 0.0: " flat", 1.0: " R 1"}
SIZES = [f"Ø {2 * tool['radius_mm']:g}{CORNERS[tool['corner_radius_mm']]}" for tool in TOOLS]


def told(page: Page) -> list[list[dict[str, Any]] | None]:
    """What the server is told is there: lists of tools, None: the usual ones."""
    found: list[list[dict[str, Any]] | None] = []

    def answer(route: Route) -> None:
        if route.request.method == "GET":
            route.fallback()
            return
        rows = route.request.post_data_json["tools"] if route.request.method == "PUT" else None
        found.append(rows)
        full = [{"flutes": 2, "max_rpm": 30000.0, "cost_class": 2} | row for row in rows or TOOLS]
        route.fulfill(json={"tools": full, "own": rows is not None})

    page.route("**/v1/tools", answer)
    return found


def test_cutters_are_added_and_taken_away_by_diameter_and_the_plan_is_asked_for_again(opened: Opened) -> None:
    page = opened("#/new")
    lists = told(page)
    cutters = page.locator(".shop > details", has_text="Your cutters")
    cutters.locator("summary").click()
    items = cutters.get_by_role("listitem")
    expect(items).to_have_text([f"{size}×" for size in SIZES])
    expect(cutters.get_by_role("button", name="Back to the usual ones")).to_be_hidden()
    cutters.get_by_role("button", name=f"Take away {SIZES[0]}", exact=True).click()
    expect(items).to_have_text([f"{size}×" for size in SIZES[1:]])
    cutters.get_by_label("Diameter").fill("2.5")
    cutters.get_by_label("Cutting length").fill("9")
    cutters.get_by_role("button", name="Add").click()
    expect(items).to_have_text([*(f"{size}×" for size in SIZES[1:]), "Ø 2.5×"])
    assert lists[0] == TOOLS[1:] and lists[1] is not None
    assert lists[1][-1] == {
        "name": "ball-r1.25", "radius_mm": 1.25, "corner_radius_mm": None,
        "flute_length_mm": 9, "shank_radius_mm": 1.5875, "stick_out_mm": 30, "flutes": 2, "number": None,
    }  # fmt: skip
    cutters.get_by_label("Diameter").fill("8")
    cutters.get_by_label("Corner radius").fill("0")
    cutters.get_by_role("button", name="Add").click()
    expect(items.last).to_have_text("Ø 8 flat×")
    assert lists[2] is not None and lists[2][-1]["corner_radius_mm"] == 0
    cutters.get_by_role("button", name="Back to the usual ones").click()
    expect(items).to_have_text([f"{size}×" for size in SIZES])
    assert lists[3] is None


def test_a_cutter_that_cannot_be_is_said_and_nothing_changes(opened: Opened) -> None:
    page = opened("#/new", errors=("status of 422",))
    detail = "tools.toml: tool 9: flute_length_mm = 0.2: allowed: at least the ball's radius, 1 mm"
    page.route(
        "**/v1/tools",
        lambda route: (
            route.fallback() if route.request.method == "GET" else route.fulfill(status=422, json={"detail": detail})
        ),
    )
    cutters = page.locator(".shop > details", has_text="Your cutters")
    cutters.locator("summary").click()
    cutters.get_by_label("Diameter").fill("2")
    cutters.get_by_label("Cutting length").fill("0.2")
    cutters.get_by_role("button", name="Add").click()
    expect(cutters.get_by_role("alert")).to_contain_text("at least the ball's radius")
    expect(cutters.get_by_role("listitem")).to_have_text([f"{size}×" for size in SIZES])
