"""Every screen in its states, at every width, light and dark, for everybody: nothing cut, nothing in the way."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.levels import mostly_thorough
from tests.page import jobs
from tests.page.browser import NOWHERE, Scheme, layout_faults, open_blank, serious_faults
from tests.page.canned_job import ESTIMATE_EXAMPLE
from tests.page.conftest import Opened
from tests.page.form import refuse_picture, unfold
from tests.page.listed import answer_with, summary
from tests.page.machine_states import NAME as MILL
from tests.page.machine_states import STATES, USED, machine_in, told, with_control
from tests.page.shop import PICTURE

Screen = Callable[[Opened], Page]

LONG_NAME = "portrait-of-a-very-long-name_that_has_no_place_to_break_it_2026-11-21_final.png"
FAULT = {"stage": "pass-2", "detail": "the ball of 3 mm " + "does not fit, " * 20, "field": "spec.passes.1.radius_mm"}
# (width, height, theme, whether axe-core listens); a phone and a browser at 200 % and a keyboard over a phone, too.
SIZES: dict[str, tuple[int, int, Scheme, bool]] = {
    "wide": (1440, 900, "light", True),
    "tablet": (1024, 768, "dark", False),
    "phone": (390, 844, "dark", True),
    "narrow": (320, 640, "light", False),
    "zoomed": (720, 450, "dark", False),
    "keyboard": (390, 420, "light", False),
}
STYLES = ("job/job.css", "machine/machine.css", "new/new.css")
OPEN_FOLDS = """() => {
    for (const fold of document.querySelectorAll("details")) if (fold.checkVisibility()) fold.open = true;
}"""
PLACES = """async () => {
    const now = () => [...document.querySelectorAll("main *")].filter((one) => one.checkVisibility()).map((one) => {
        const {x, y, width, height} = one.getBoundingClientRect();
        return [one.tagName, one.getAttribute("class"), x, y, width, height].join(" ");
    });
    for (let before = "", found = now();; before = found.join(), found = now()) {
        if (found.join() === before) return found; // nothing is on its way any more
        await new Promise((done) => setTimeout(done, 300));
    }
}"""


def of_jobs(opened: Opened) -> Page:
    page = opened("#/machines")
    states = ("queued", "running", "succeeded", "failed", "cancelled")
    more = {"queued": {"queue_position": 3, "name": LONG_NAME}, "failed": {"error": FAULT, "name": LONG_NAME}}
    answer_with(page, [summary(k, states[k % 5], **more.get(states[k % 5], {})) for k in range(40)])
    page.evaluate("location.hash = '#/'")
    expect(page.get_by_role("listitem")).to_have_count(40)
    return page


def of_the_key(opened: Opened) -> Page:
    page = opened()
    page.get_by_role("button", name="Enter code").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    return page


def of_a_new_job(opened: Opened) -> Page:
    page = open_blank(opened, "new")
    page.route("**/v1/estimates", lambda route: route.fulfill(json=ESTIMATE_EXAMPLE))
    page.evaluate("location.hash = '#/new'")
    page.locator("input[type=file]").first.set_input_files(PICTURE)
    expect(page.get_by_role("region", name="Estimate").get_by_text("Machine time")).to_be_visible()
    return page


def of_a_picture_that_is_none(opened: Opened) -> Page:
    page = opened("#/new", errors=("status of 422",))
    refuse_picture(page)
    expect(page.locator(".submit-bar .why")).to_contain_text("not a picture")
    return page


def of_a_new_job_with_everything(opened: Opened) -> Page:
    page = of_a_new_job(opened)
    unfold(page)
    page.get_by_role("radio", name=re.compile("^Lamp")).check()
    page.get_by_label("Set every pass by hand").check()
    for label, value in (("Width", "abc"), ("Height", "two")):
        page.get_by_label(label, exact=True).fill(value)
    page.get_by_role("button", name="Make the lens").click()
    expect(page.get_by_text("'abc' is not a number.")).to_be_visible()
    expect(page.locator(".stale")).to_have_count(0)  # dimmed while it is asked for anew
    return page


def of_a_job(state: str, **more: Any) -> Screen:
    def screen(opened: Opened) -> Page:
        job, files = jobs.canned()
        return jobs.shown(opened, jobs.like(job, 1, name=LONG_NAME, state=state, **more), files[:4])

    return screen


def of_a_finished_job(opened: Opened) -> Page:
    page = jobs.shown(opened, *jobs.canned())
    for part in ("#pictures-title", "#lens-title", "#path-title", "#files-title"):
        page.locator(part).scroll_into_view_if_needed()
    expect(page.locator("[data-level]")).to_be_attached()
    return page


def of_a_job_without_results(state: str) -> Screen:
    def screen(opened: Opened) -> Page:
        stages = jobs.stopped_at(jobs.canned()[0], "image", "cancelled" if state == "cancelled" else "waiting")
        return of_a_job(state, report=None, programs=[], stages=stages, progress=0.0, queue_position=3)(opened)

    return screen


def of_no_jobs(opened: Opened) -> Page:
    page = opened(NOWHERE)
    answer_with(page, [])
    page.evaluate("location.hash = '#/'")
    expect(page.locator(".drop")).to_be_visible()
    return page


def of_a_plan(opened: Opened) -> Page:
    job, files = jobs.canned()
    page = jobs.shown(opened, jobs.with_plan(job, 2), files)
    for part in ("#pictures-title", "#plan-title", "#lens-title", "#path-title", "#files-title"):
        page.locator(part).scroll_into_view_if_needed()
    expect(page.locator("[data-level]")).to_be_attached()
    return page


def of_two_jobs(opened: Opened) -> Page:
    page = compared(opened)
    expect(page.locator(".walls-compared img[src]")).to_have_count(2)
    return page


def of_two_jobs_without_pictures(opened: Opened) -> Page:
    """They are on their way, and stay there."""
    return compared(opened, pictures="**/*.png")


def compared(opened: Opened, pictures: str = "") -> Page:
    job, files = jobs.canned()
    other = jobs.like(job, 3, name=LONG_NAME, spec=job["spec"] | {"image": job["spec"]["image"] | {"pixels": 128}})
    page = open_blank(opened, "job")
    jobs.answer(page, other, files)
    if pictures:
        page.route(pictures, lambda _route: None)
    page.evaluate("([a, b]) => { location.hash = `#/compare/${a}/${b}` }", [job["id"], other["id"]])
    expect(page.get_by_role("heading", level=1, name="Compare")).to_be_visible()
    return page


def of_the_key_beside_a_mill(opened: Opened) -> Page:
    """HOLD and STOP are used while it is asked for."""
    page = open_blank(opened, "machine")
    told(page, "running")
    page.evaluate(f"location.hash = '#/machines/{MILL}'")
    page.get_by_role("button", name="Take over").click()
    page.get_by_role("group", name="Take over").get_by_role("button", name="Take over").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    for name in ("HOLD", "STOP"):
        page.get_by_role("button", name=name).click(trial=True)
    return page


def of_a_question(opened: Opened) -> Page:
    page = of_a_job("failed", error=FAULT)(opened)
    page.get_by_role("button", name="Delete").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    return page


def of_machines(opened: Opened) -> Page:
    page = open_blank(opened, "machine")
    found = [machine_in(state)[0] | {"name": f"{state}-{LONG_NAME}"} for state in STATES]
    told = {"machines": found, "problems": [f"{LONG_NAME}: line 3: no value"]}
    page.route("**/v1/machines", lambda route: route.fulfill(json=told))
    page.evaluate("location.hash = '#/machines'")
    expect(page.get_by_role("listitem")).to_have_count(len(STATES))
    return page


def of_a_machine(state: str) -> Screen:
    """With control of it: every button that this state leaves is on."""

    def screen(opened: Opened) -> Page:
        page = with_control(opened, state)
        page.evaluate(OPEN_FOLDS)  # at once: while they are clicked one by one, news of the mill may take one away
        return page

    return screen


SCREENS: dict[str, Screen] = {
    "jobs": of_jobs,
    "no-jobs": of_no_jobs,
    "key": of_the_key,
    "new": of_a_new_job,
    "new-broken": of_a_picture_that_is_none,
    "new-everything": of_a_new_job_with_everything,
    "job": of_a_finished_job,
    "job-failed": of_a_job("failed", error=FAULT),
    "job-running": of_a_job("running", progress=0.4, report=None, programs=[]),
    "job-queued": of_a_job_without_results("queued"),
    "job-cancelled": of_a_job_without_results("cancelled"),
    "job-planned": of_a_plan,
    "two-jobs": of_two_jobs,
    "two-jobs-waiting": of_two_jobs_without_pictures,
    "question": of_a_question,
    "machines": of_machines,
    "machine-key": of_the_key_beside_a_mill,
    **{f"machine-{state}": of_a_machine(state) for state in USED},
}


QUICK = ("jobs", "machine-interrupted")


@pytest.mark.parametrize("name", mostly_thorough(SCREENS, quick=QUICK))
def test_nothing_is_cut_or_in_the_way_at_any_width_in_any_theme(open_unpainted: Opened, name: str) -> None:
    page = SCREENS[name](open_unpainted)
    for size, (width, height, scheme, heard) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=scheme)
        assert layout_faults(page) == [], size
        if heard:
            assert serious_faults(page) == [], size
        for button in page.locator(":is(.stops, .submit-bar) .big:visible").all():
            expect(button).to_be_in_viewport(ratio=1)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["jobs", "new", "job-planned", "machine-idle"])
def test_a_view_looks_the_same_whatever_was_looked_at_before(open_unpainted: Opened, name: str) -> None:
    """Sheets stay once they are loaded: none of them may change another view."""
    page = SCREENS[name](open_unpainted)
    before = page.evaluate(PLACES)
    page.evaluate(
        "async (names) => { const { sheet } = await import('/page/lib/dom.js');"
        "for (const name of names) await sheet(`/page/${name}`); }",
        STYLES,
    )
    assert page.evaluate(PLACES) == before
