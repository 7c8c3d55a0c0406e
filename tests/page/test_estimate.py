"""What is to be expected of a job, told while a person still turns the knobs."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Route, expect

from cam.materials import MATERIALS
from service.job.picture.light_png import picture_png
from service.job.picture.linear_light import linear_to_srgb
from service.job.spec.loading import resolve_spec
from service.wording import likeness_in_words
from tests.page import canned_job
from tests.page.answers import problem
from tests.page.browser import Watched, open_blank
from tests.page.canned_job import ESTIMATE_EXAMPLE
from tests.page.conftest import Opened, visit
from tests.page.form import choose, fill, make_it, parts, picture, wall
from tests.page.jobs import alike
from tests.page.test_next_step import after


def edge(side: int = 300) -> bytes:
    """Half of it dark."""
    file = io.BytesIO()
    Image.fromarray(np.tile(np.where(np.arange(side) < side // 2, 60, 220).astype(np.uint8), (side, 1))).save(
        file, "PNG"
    )
    return file.getvalue()


WRONG = {"field": "spec.optics.throw_mm", "detail": "0 is not allowed; allowed: a number more than 0"}


def test_the_estimate_says_what_is_to_be_expected_and_what_is_wrong(opened: Opened) -> None:
    page = open_blank(opened, "new", errors=("status of 422",))

    def example(route: Route) -> None:
        if "throw_mm" in parts(route)[0].get("optics", {}):
            route.fulfill(**problem(422, detail="see there", problems=[WRONG]))
        else:
            route.fulfill(json=ESTIMATE_EXAMPLE)

    page.route("**/v1/estimates", example)
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    estimate = page.get_by_role("region", name="Estimate")
    expect(estimate).to_contain_text("Machine time")
    expect(page.locator(".told")).to_have_text(likeness_in_words(ESTIMATE_EXAMPLE["seen_db"]))
    expect(estimate.get_by_role("list", name="Passes").get_by_role("listitem")).to_have_count(
        len(ESTIMATE_EXAMPLE["passes"])
    )
    for words in ESTIMATE_EXAMPLE["warnings"]:
        expect(estimate).to_contain_text(words[1:])
    expect(page.locator(".submit-bar")).to_contain_text("of milling")
    fill(page, Distance_to_the_wall="0")
    expect(page.get_by_label("Distance to the wall")).to_have_accessible_description(re.compile("more than 0"))
    expect(estimate.get_by_text("Machine time")).to_have_count(0)


def test_the_estimate_says_what_must_be_at_hand(opened: Opened) -> None:
    """Block with its margin and what is faced off, each cutter once, and the wall; of what is usual too."""
    page = open_blank(opened, "new")
    tools = ["cutter R 5 (Ø 10 mm)", "ball R 3 (Ø 6 mm)", "ball R 3 (Ø 6 mm)", "ball R 0.5 (Ø 1 mm)"]
    given = {
        "optics": {"width_mm": 60.5, "throw_mm": 150.0},
        "stock": {"margin_mm": 10.0, "thickness_mm": 25.0, "material": "pmma", "face": {"above_mm": 0.5}},
    }
    answers: list[dict[str, Any]] = [
        {"passes": [{"name": "finish", "tool": tool, "hours": 1.0} for tool in tools], "spec": given},
        {"passes": ESTIMATE_EXAMPLE["passes"], "spec": {"preset": "draft"}},
    ]
    page.route("**/v1/estimates", lambda route: route.fulfill(json=ESTIMATE_EXAMPLE | answers.pop(0)))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    told = page.get_by_role("region", name="Estimate").locator(".shopping")
    expect(told).to_contain_text("Block 80.5 × 120 × 25.5 mm")
    for cutter in ("Cutter Ø 10 mm", "Ball Ø 6 mm", "Ball Ø 1 mm"):
        expect(told.get_by_text(cutter)).to_have_count(1)
    fill(page, Width="90")
    usual = resolve_spec(preset="draft")
    margin_mm = 2 * usual.stock.margin_mm
    sides = usual.optics.width_mm + margin_mm, usual.optics.height_mm + margin_mm, usual.stock.thickness_mm
    expect(told).to_contain_text(
        " × ".join(f"{side:g}" for side in sides) + f" mm{MATERIALS[usual.stock.material].label}"
    )


def test_what_is_missing_is_a_shopping_list(opened: Opened) -> None:
    """Until a person ticks it, or says how large the block is; both are kept for the next job."""
    page = open_blank(opened, "new")
    answer = ESTIMATE_EXAMPLE | {"spec": {"preset": "draft", "finish": {"process": "felt"}}, "plans": []}
    page.route("**/v1/estimates", lambda route: route.fulfill(json=answer))
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    estimate = page.get_by_role("region", name="Estimate")
    expect(estimate.get_by_text("Shopping list: tick what you have")).to_be_visible()
    for words in ("Ball Ø 6 mm", "Felt and compound"):
        estimate.get_by_role("checkbox", name=words).check()
    expect(estimate.get_by_text("Shopping list: 1 of 3 to get")).to_be_visible()
    block = estimate.get_by_role("checkbox", name="Block 128 × 128 × 40 mm")
    for length, is_enough in (("110", False), ("130", True)):
        page.get_by_label("Length and width of the block length").fill("140")
        page.get_by_label("Length and width of the block width").fill(length)
        expect(block).to_be_checked(checked=is_enough)
    expect(estimate.get_by_text("You have all of it")).to_be_visible()
    expect(page.locator(".own > summary")).to_contain_text("block 140 × 130 × 40 mm")
    page.evaluate("localStorage.clear()")


def test_plans_are_walls_to_choose_from(opened: Opened) -> None:
    """Figures and wall are those of the chosen one; the job that is sent has its values, the usual one none."""
    page = open_blank(opened, "new", errors=("status of 422",))
    quick, usual, sharp = ESTIMATE_EXAMPLE["plans"]
    walls = [even(level)["wall"] for level in (0.25, 0.5, 0.75)]
    answer = ESTIMATE_EXAMPLE | {"plans": [p | {"wall": w} for p, w in zip((quick, usual, sharp), walls, strict=True)]}
    sent: list[Any] = []
    page.route("**/v1/estimates", lambda route: route.fulfill(json=answer))

    def take(route: Route) -> None:
        sent.append(parts(route)[0])
        route.fulfill(status=422, json={"status": 422, "detail": "enough for this test"})

    page.route("**/v1/jobs", take)
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    plans = page.get_by_role("group", name="Plans to choose from").get_by_role("radio")
    expect(plans).to_have_count(3)
    expect(plans.nth(1)).to_be_checked()
    expect(plans.nth(0)).to_have_accessible_name("1 h 13 min quickest then 2 h 1 min by hand 96 % alike")
    for number, (plan, hours) in enumerate(((quick, "1 h 13 min"), (usual, "2 h 13 min"), (sharp, "8 h 1 min"))):
        plans.nth(number).check()
        expect(page.get_by_role("region", name="Estimate")).to_contain_text(f"Machine time{hours}")
        grey = round(255 * float(linear_to_srgb(np.array((0.25, 0.5, 0.75)[number]))))
        if plan is not usual:
            page.wait_for_function(f"() => ({GREY})('canvas.wall').every((one) => Math.abs(one - {grey}) <= 1)")
        with page.expect_response("**/v1/jobs"):
            make_it(page).click()
        assert sent[-1].get("passes") == (None if plan is usual else plan["spec"]["passes"])
        assert sent[-1]["preset"] == "recommended"
    fill(page, Width="50")
    expect(plans.nth(2)).to_be_disabled()


GREY = """(name) => {
    const canvas = document.querySelector(name), { width, height } = canvas, box = [0, 0, width, height];
    return [...canvas.getContext("2d").getImageData(...box).data].filter((_, k) => k % 4 === 0);
}"""
NOT_YET = "the picture as asked for: its light is not worked out yet"


def even(level: float) -> dict[str, str]:
    """Of an estimate: light that no picture has."""
    packed = picture_png(np.full((8, 8), level), white=1.0)
    return {"wall": f"data:image/png;base64,{base64.b64encode(packed).decode()}"}


def test_the_wall_shows_the_light_of_the_estimate_and_until_it_is_there_the_picture_and_says_so(opened: Opened) -> None:
    """Of what is set now: nobody takes the picture, or the light of what was set before, for what will be there."""
    page = open_blank(opened, "new", errors=("status of 422",))
    asked: list[Route] = []
    page.route("**/v1/estimates", lambda route: asked.append(route))
    page.route("**/v1/estimates?exactly=true", lambda route: asked.append(route))
    page.evaluate("location.hash = '#/new'")
    choose(page, edge())
    told = page.locator(".told")

    def shows_picture() -> None:
        expect(told).to_have_text(NOT_YET)
        expect(wall(page)).to_have_css("opacity", "0.4")
        same = "(one, other) => one.every((grey, k) => Math.abs(grey - other[k]) <= 1)"
        page.wait_for_function(f"() => ({same})(({GREY})('canvas.sharp'), ({GREY})('canvas.wall'))")

    def shows_light(level: float) -> None:
        expect(wall(page)).to_have_css("opacity", "1")
        grey = round(255 * float(linear_to_srgb(np.array(level))))
        page.wait_for_function(f"() => ({GREY})('canvas.wall').every((one) => Math.abs(one - {grey}) <= 1)")

    after(asked, 1, page)
    shows_picture()
    asked[-1].fulfill(json=ESTIMATE_EXAMPLE | even(0.5) | {"exact": False})
    shows_light(0.5)
    expect(told).to_have_text("a first look")
    after(asked, 2, page)
    asked[-1].fulfill(json=ESTIMATE_EXAMPLE | even(0.25))
    shows_light(0.25)
    expect(told).to_have_text(likeness_in_words(ESTIMATE_EXAMPLE["seen_db"]))
    expect(page.locator(".stale")).to_have_count(0)
    fill(page, Distance_to_the_wall="200")
    shows_picture()
    expect(page.locator(".stale")).to_have_count(1)
    after(asked, 3, page)
    asked[-1].fulfill(**problem(422, detail="see there", problems=[WRONG]))
    expect(page.get_by_label("Distance to the wall")).to_have_attribute("aria-invalid", "true")
    shows_picture()
    fill(page, Distance_to_the_wall="150")
    after(asked, 4, page)
    asked[-1].fulfill(json=ESTIMATE_EXAMPLE | {"psnr_db": None, "seen_db": None, "wall": None})
    expect(told).to_have_text("no pass finishes the lens: the wall shows no picture")
    expect(wall(page)).to_have_css("opacity", "0.4")


def test_what_cannot_be_made_is_said_beside_its_field_with_a_cure_and_cannot_be_pressed(opened: Opened) -> None:
    """Whether the estimate refuses, or foretells that the job would fail; until it is answered otherwise."""
    page = open_blank(opened, "new", errors=("status of 422",))

    def answer(route: Route) -> None:
        spec = parts(route)[0]
        near = spec.get("optics", {}).get("throw_mm") == 10
        thin = {"field": "spec.stock.margin_mm", "detail": "it leaves 1 mm of the block", "use": 60}
        if near:
            row = {"field": "spec.optics.throw_mm", "detail": "10 mm is too near", "use": 32}
            route.fulfill(**problem(422, detail="see there", problems=[row]))
        else:
            route.fulfill(json=ESTIMATE_EXAMPLE | {"refusals": [] if spec["stock"]["margin_mm"] == 60 else [thin]})

    page.route("**/v1/estimates", answer)
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    bar, margin = page.locator(".submit-bar"), page.get_by_label("Margin around")
    expect(bar).to_contain_text("Such a lens cannot be made. Look at:Margin around")
    expect(make_it(page)).to_be_disabled()
    page.evaluate("for (const one of document.querySelectorAll('.fold')) one.open = false")
    expect(margin).to_be_hidden()
    bar.get_by_role("button", name="Margin around").click()
    expect(margin).to_be_focused()
    page.get_by_role("button", name="Use 60 mm").click()
    expect(margin).to_have_value("60")
    expect(make_it(page)).to_be_enabled()
    fill(page, Distance_to_the_wall="10")
    throw = page.get_by_label("Distance to the wall")
    expect(throw).to_have_accessible_description(re.compile("10 mm is too near"))
    expect(make_it(page)).to_be_disabled()
    page.route("**/v1/estimates", lambda _route: None)  # it takes its time
    fill(page, Width="40")  # another field may cure it, so nothing is known of it now
    expect(throw).to_have_attribute("aria-invalid", "false")
    page.unroute("**/v1/estimates")
    page.route("**/v1/estimates", answer)
    fill(page, Width="41")
    expect(make_it(page)).to_be_disabled()
    page.get_by_role("button", name="Use 32 mm").click()
    expect(make_it(page)).to_be_enabled()
    expect(page.get_by_label("Distance to the wall")).to_have_value("32")
    expect(bar).not_to_contain_text("Look at")
    fill(page, Width="abc", Height="two")
    bar.get_by_role("button", name="Height").click()
    expect(page.get_by_label("Height", exact=True)).to_be_focused()
    red = page.locator(".field:has([aria-invalid=true]):visible .fault")
    expect(red).to_have_text(["'abc' is not a number.", "'two' is not a number."])
    expect(bar.locator(".why")).to_have_text("Look at:WidthHeight")


@pytest.mark.thorough
def test_a_first_look_gives_way_to_the_exact_answer_unless_something_is_changed_meanwhile(opened: Opened) -> None:
    page = open_blank(opened, "new", errors=("status of 503",))
    answers: list[dict[str, Any] | None] = [
        None,  # it is still worked on when something is changed
        {"json": ESTIMATE_EXAMPLE | {"hours": 5.0}},
        problem(503, detail="no room"),
    ]

    def answer_exactly(route: Route) -> None:
        if answer := answers.pop(0):
            route.fulfill(**answer)

    page.route("**/v1/estimates", lambda route: route.fulfill(json=ESTIMATE_EXAMPLE | {"exact": False, "hours": 2.0}))
    page.route("**/v1/estimates?exactly=true", answer_exactly)
    page.evaluate("location.hash = '#/new'")
    estimate = page.get_by_role("region", name="Estimate")
    with page.expect_request("**/v1/estimates?exactly=true"):
        choose(page, picture())
    expect(estimate).to_contain_text("A first look: exact figures follow")
    expect(estimate).to_contain_text("Smallest detail…")
    fill(page, Width="30")
    expect(estimate).to_contain_text("5 h")
    expect(estimate).not_to_contain_text("A first look")
    expect(estimate).not_to_contain_text("…")
    fill(page, Width="40")
    expect(estimate).to_contain_text("the exact figures could not be worked out")
    expect(estimate).to_contain_text("2 h")
    assert not answers


CHANGES = [
    {"what": "a lens of 150 x 150 mm", "values": {"optics.width_mm": 150, "optics.height_mm": 150}},
    {"what": "the wall 65 mm away", "values": {"optics.throw_mm": 65}},
    {"what": "a picture prepared for what will show", "values": {"image.prepare": "detail"}},
    {"what": "passes as recommended", "values": {"preset": "recommended"}},
]


def test_a_picture_hard_to_recognise_comes_with_changes_that_show_more_and_a_button_for_each(opened: Opened) -> None:
    """Best first; none that would be refused, or that shows hardly more."""
    page = open_blank(opened, "new")

    def foretell(route: Route) -> None:
        spec = parts(route)[0]
        seen = {"psnr_db": 18.0, "seen_db": 8.0, "changes": CHANGES}
        if spec.get("optics", {}).get("width_mm") == 150:
            seen |= {"psnr_db": 22.0, "seen_db": 12.0, **even(0.5)}
        elif "throw_mm" in spec.get("optics", {}):
            seen |= {"psnr_db": 30.0, "refusals": [{"field": "spec.optics.throw_mm", "detail": "too near"}]}
        elif spec.get("image", {}).get("prepare") == "detail":
            seen |= {"psnr_db": 24.0, "seen_db": 14.0, **even(0.25)}
        route.fulfill(json=ESTIMATE_EXAMPLE | seen)

    page.route("**/v1/estimates", foretell)
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    shown = page.get_by_role("region", name="What would show more")
    expect(shown.get_by_role("button")).to_have_text(
        ["A picture prepared for what will show", "A lens of 150 x 150 mm"]
    )
    expect(shown.get_by_role("listitem").nth(1)).to_contain_text(alike(12.0))
    for number, level in enumerate((0.25, 0.5)):  # what the wall shows of each is of its own estimate
        expect(shown.get_by_role("listitem").nth(number).locator("img")).to_have_attribute("src", even(level)["wall"])
    shown.get_by_role("button", name="A lens of").click()
    expect(page.get_by_label("Width", exact=True)).to_have_value("150")
    expect(shown.get_by_role("button", name="What would show more?")).to_be_visible()  # it is not hard any more
    page.get_by_role("button", name="Undo").click()
    expect(page.get_by_label("Width", exact=True)).not_to_have_value("150")


@pytest.mark.parametrize(("way", "seen_db"), [("&show=more", 8.0), ("&show=more", 14.5), ("", 8.0)])
def test_who_comes_from_a_job_for_what_shows_more_is_led_there(opened: Opened, way: str, seen_db: float) -> None:
    """And it is worked out, whatever the estimate says; a plain copy begins at its top."""
    page = open_blank(opened, "new", size="phone")
    told = {"seen_db": seen_db, "changes": CHANGES[:1]}
    page.route(
        "**/v1/estimates",
        lambda route: route.fulfill(
            json=ESTIMATE_EXAMPLE | (told if "optics" not in parts(route)[0] else {"psnr_db": 30.0})
        ),
    )
    asked = canned_job.request()
    page.route("**/request", lambda route: route.fulfill(json=asked | {"spec": {"preset": "draft"}}))
    page.route(f"**{asked['image']}", lambda route: route.fulfill(body=picture()))
    page.evaluate("address => { location.hash = address }", f"#/new?from={canned_job.JOB_ID}{way}")
    shown = page.get_by_role("region", name="What would show more")
    expect(shown.get_by_role("listitem")).to_have_count(1)
    if way:
        expect(shown).to_be_focused()
        expect(shown).to_be_in_viewport()
    else:
        expect(shown).not_to_be_focused()
        assert page.evaluate("scrollY") == 0


def test_what_is_worked_out_exactly_is_not_asked_again(opened: Opened) -> None:
    """Back to values that were there before: their estimate is shown at once, until the cutters are others."""
    page = open_blank(opened, "new")
    asked: list[str] = []

    def answer(route: Route) -> None:
        exact = route.request.url.endswith("exactly=true")
        width = parts(route)[0].get("optics", {}).get("width_mm", 100)
        asked.append(f"{width} exactly" if exact else f"{width}")
        route.fulfill(json=ESTIMATE_EXAMPLE | {"exact": exact, "hours": width / 10})

    page.route(re.compile("/v1/estimates"), answer)
    page.evaluate("location.hash = '#/new'")
    choose(page, picture())
    line = page.locator(".submit-bar .line").first
    for width, hours in ((None, "10 h"), ("50", "5 h"), ("100", "10 h")):
        if width is not None:
            fill(page, Width=width)
        expect(line).to_have_text(re.compile(f"About {hours} of milling, then"))
    assert asked == ["100", "100 exactly", "50", "50 exactly"]


@pytest.mark.parametrize("changed", [False, True])
def test_the_exact_estimate_gets_the_picture_that_the_job_gets(opened: Opened, changed: bool) -> None:
    """Only then do they share a plan. The first look gets a smaller copy of a large picture."""
    page = open_blank(opened, "new", errors=("status of 422",))
    sent: dict[str, bytes] = {}

    def answer(route: Route) -> None:
        exact = route.request.url.endswith("exactly=true")
        sent["exact" if exact else "coarse"] = parts(route)[1]
        route.fulfill(json=ESTIMATE_EXAMPLE | {"exact": exact})

    def take(route: Route) -> None:
        sent["job"] = parts(route)[1]
        route.fulfill(status=422, json={"status": 422, "detail": "enough for this test"})

    page.route(re.compile("/v1/estimates"), answer)
    page.route("**/v1/jobs", take)
    page.evaluate("location.hash = '#/new'")
    with page.expect_response(re.compile("exactly=true")):
        choose(page, picture(1200, 1100))
    if changed:
        with page.expect_response(re.compile("exactly=true")):
            page.get_by_role("button", name="Mirror").click()
    with page.expect_response("**/v1/jobs"):
        make_it(page).click()
    assert len(set(sent.values())) == 2
    assert sent["exact"] == sent["job"]


@pytest.mark.thorough
def test_only_an_older_question_of_the_same_tab_is_ended(opened: Opened) -> None:
    """Each tab has a name of its own, by which the server knows it; a page that is loaded anew is another tab."""
    page = open_blank(opened, "new")
    asked: list[set[str]] = []

    def note(route: Route) -> None:
        asked[-1].add(route.request.headers["causticmill-tab"])
        route.fulfill(json=ESTIMATE_EXAMPLE)

    page.route("**/v1/estimates", note)
    for _ in range(2):
        page.goto("about:blank")  # nobody asks any more
        asked.append(set())
        visit(page, "#/new")
        for step in (lambda: choose(page, picture()), lambda: fill(page, Width="30")):
            with page.expect_request("**/v1/estimates"):
                step()
    first, second = asked
    assert len(first) == len(second) == 1 and first != second


@pytest.mark.thorough
def test_a_long_wait_is_explained(watched: Callable[..., Watched]) -> None:
    page = watched().page()  # whose clock is its context's
    visit(page, "#/machines")
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
    after(waiting, 1, page)  # a question that the page prepares for a while
    waiting[0].fulfill(json=ESTIMATE_EXAMPLE)
    expect(estimate).to_contain_text("Machine time")
    expect(estimate).not_to_contain_text("installation")
