"""What is to be expected of a job, told while a person still turns the knobs."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Route, expect

from service.api.schemas_estimates import ESTIMATE_EXAMPLE
from service.report_words import psnr_in_words
from tests.page.conftest import Opened
from tests.page.shop import Shop
from tests.page.test_new_job import choose, fill, parts, picture, wall

FIRST_MS = 120_000  # kernels may have to be compiled


def test_the_estimate_says_what_is_to_be_expected_and_what_is_wrong(opened: Opened) -> None:
    page = opened("#/machines", errors=("status of 422",))

    def example(route: Route) -> None:
        spec, _ = parts(route)
        route.fallback() if "throw_mm" in spec.get("optics", {}) else route.fulfill(json=ESTIMATE_EXAMPLE)

    page.route("**/v1/estimates", example)
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    estimate = page.get_by_role("region", name="Estimate")
    expect(estimate).to_contain_text("Machine time")
    expect(estimate).to_contain_text(psnr_in_words(ESTIMATE_EXAMPLE["psnr_db"]))
    expect(estimate.get_by_role("list", name="Passes").get_by_role("listitem")).to_have_count(
        len(ESTIMATE_EXAMPLE["passes"])
    )
    for words in (*ESTIMATE_EXAMPLE["warnings"], *ESTIMATE_EXAMPLE["refusals"]):
        expect(estimate).to_contain_text(words[1:])
    expect(page.locator(".submit-bar")).to_contain_text("of milling")
    sharp = page.get_by_label("with the blur that the tool's marks will leave")
    blurred = wall(page).evaluate("one => one.toDataURL()")
    sharp.uncheck()
    page.wait_for_function("before => document.querySelector('canvas.wall').toDataURL() !== before", arg=blurred)
    fill(page, Distance_to_the_wall="0")
    expect(page.get_by_label("Distance to the wall")).to_have_accessible_description(re.compile("more than 0"))
    expect(estimate.get_by_text("Machine time")).to_have_count(0)


LINE = "estimate => import('/page/new/estimate.js').then(({estimateLine}) => estimateLine(estimate))"


def test_a_picture_hard_to_recognise_comes_with_what_makes_it_plainer(opened: Opened) -> None:
    """By what costs it most; nobody is told to take what was taken already."""
    page = opened()
    lamp = {"blur_by": {"light_mm": 2.0, "milling_mm": 1.0}, "planned": True}
    for change, words in (
        ({"psnr_db": 21.0}, "visibly soft or uneven"),
        ({}, "hard to recognise: “Recommended” or a larger lens shows more"),
        ({"planned": True}, "hard to recognise: a larger lens shows more"),
        (lamp | {"spec": {"optics": {"light": {"kind": "sun"}}}}, ": a nearer wall or a larger lens shows more"),
        (lamp | {"spec": {"optics": {"light": {"kind": "point"}}}}, ": a smaller lamp or a larger lens shows more"),
    ):
        assert page.evaluate(LINE, ESTIMATE_EXAMPLE | {"psnr_db": 20.9} | change).endswith(words)


@pytest.mark.thorough
def test_two_tabs_side_by_side_get_their_estimates_both(opened: Opened, shop: Shop) -> None:
    """One computer, one caller; only of the same tab the newer question ends the older one."""
    pages = [opened("#/new") for _ in range(2)]
    for page in pages:
        page.get_by_label("Draft").check()
        choose(page, picture())
    for page in pages:
        estimate = page.get_by_role("region", name="Estimate")
        expect(estimate).to_contain_text("Machine time", timeout=FIRST_MS)
        expect(estimate).not_to_contain_text("No estimate")


@pytest.mark.thorough
def test_a_long_wait_is_explained(opened: Opened) -> None:
    page = opened("#/machines")
    page.clock.install()
    waiting: list[Route] = []
    page.route("**/v1/estimates", lambda route: waiting.append(route))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    estimate = page.get_by_role("region", name="Estimate")
    page.clock.run_for(1000)
    expect(estimate).to_contain_text("Working it out")
    expect(estimate).not_to_contain_text("installation")
    page.clock.run_for(5000)
    expect(estimate).to_contain_text("The first one after an installation or an update takes up to a minute")
    waiting[0].fulfill(json=ESTIMATE_EXAMPLE)
    expect(estimate).to_contain_text("Machine time")
    expect(estimate).not_to_contain_text("installation")
