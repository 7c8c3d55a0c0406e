"""A job whose passes the server has planned: the plans it offers are taken as they are."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

from service.spec_files import resolve_spec
from tests.page.browser import serious_faults
from tests.page.conftest import Opened
from tests.page.shop import Shop
from tests.page.test_new_job import as_floats, parts
from tests.waiting import until

SPEC: dict[str, Any] = {"preset": "recommended", "image": {"pixels": 64}, "optics": {"width_mm": 20, "height_mm": 20}}

pytestmark = pytest.mark.thorough  # lenses are designed for a dozen plans


@pytest.fixture(scope="module")
def planned(shop: Shop) -> Iterator[dict[str, Any]]:
    """A fresh job, as far as its plan; the plan is all that is needed of it."""
    job = shop.submit(SPEC)
    with shop.client() as client:
        found: dict[str, Any] = {}

        def has_plan() -> bool:
            found.update(client.get(f"/v1/jobs/{job}").json())
            assert found["state"] in ("queued", "running", "succeeded"), found
            return bool((found["report"] or {}).get("plan"))

        until(has_plan, what="a plan")
        client.post(f"/v1/jobs/{job}:cancel")
        yield found


def test_every_plan_worth_having_is_a_point_and_the_chosen_one_is_marked(
    opened: Opened, planned: dict[str, Any]
) -> None:
    rows = planned["report"]["plan"]["candidates"]
    page = opened(f"#/jobs/{planned['id']}")
    points = page.get_by_role("radio", name="will blur")
    expect(points).to_have_count(len(rows))
    assert len(rows) > 1
    boxes = "dots => dots.map((dot) => dot.getBoundingClientRect()).map(({x, y}) => [x, -y])"
    places = page.locator("[role=radio] .plan-dot").evaluate_all(boxes)  # all at once: pictures that come move the page
    assert len(places) == len(rows)
    assert places == sorted(places) and [y for _, y in places] == sorted(y for _, y in places)
    expect(points.nth(planned["report"]["plan"]["chosen"])).to_have_accessible_name(re.compile("this job's plan"))
    assert serious_faults(page) == []


def test_another_plan_is_a_click_away_from_its_own_job(opened: Opened, planned: dict[str, Any]) -> None:
    """What is posted then is that plan and nothing else that the first job had not."""
    plan = planned["report"]["plan"]
    other = 0 if plan["chosen"] else len(plan["candidates"]) - 1
    page = opened(f"#/jobs/{planned['id']}", errors=("status of 422",))
    sent: list[dict[str, Any]] = []

    def take(route: Route) -> None:
        sent.append(parts(route)[0])
        route.fulfill(status=422, json={"status": 422, "detail": "enough for this test", "field": ""})

    page.route("**/v1/jobs", take)
    pick(page, other)
    page.get_by_role("link", name="Make this job").click()
    expect(page.get_by_text("with another plan")).to_contain_text(plan["candidates"][other]["words"])
    page.get_by_role("button", name="Make the lens").click()
    expect(page.get_by_text("enough for this test")).to_be_visible()
    wanted = plan["candidates"][other]["spec"]
    resolved = resolve_spec(base=as_floats(sent[0]) | {"image": {"pixels": 64}}).model_dump(mode="json")
    assert resolved["preset"] == "recommended"
    assert len(resolved["passes"]) == len(wanted["passes"])
    for ours, row in zip(resolved["passes"], wanted["passes"], strict=True):
        assert {key: ours[key] for key in row} == as_floats(row) | {key: ours[key] for key in row if row[key] is None}
    for table in ("optics", "machine"):
        for key, value in wanted[table].items():
            assert resolved[table][key] == pytest.approx(value)
    assert (resolved["optics"]["width_mm"], resolved["image"]["pixels"]) == (20, 64)


def pick(page: Page, number: int) -> None:
    """By a click on the chart, where the point is."""
    point = page.get_by_role("radio", name="will blur").nth(number)
    point.click()
    expect(point).to_have_attribute("aria-checked", "true")
