"""Two jobs have programs of the same names: which one is meant, and whose zero and tool the mill still has."""

from __future__ import annotations

import json
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

from tests.page import canned_job
from tests.page.browser import open_blank
from tests.page.conftest import Opened
from tests.page.driving import tick_all
from tests.page.machine_states import NAME, RUN, told, with_control
from tests.page.stub import summary_of

OWN, OTHER = RUN["job"], canned_job.JOB_ID  # of the last run; a newer one
FIRST, SECOND = "pass-1-rough.nc", "pass-2-finish.nc"
NAMES = {OWN: "astronaut.png", OTHER: "logo.png"}


def shown(opened: Opened, run: dict[str, Any], address: str = "") -> Page:
    """The mill's screen with control of it, after this run; two jobs have programs for it."""
    page = open_blank(opened, "machine", key="Ada")
    told(page, "finished", operator="Ada", mill={"needs": []}, run=run)
    both = [canned_job.job() | {"id": job, "name": NAMES[job]} for job in (OTHER, OWN)]
    listed = {"jobs": [summary_of(job) for job in both], "next": None}
    page.route("**/v1/jobs?*", lambda route: route.fulfill(json=listed))
    for job in (OWN, OTHER):
        page.route(f"**/v1/jobs/{job}", lambda route: route.fulfill(json=one_of(both, route.request.url)))
    page.evaluate(f"location.hash = '#/machines/{NAME}{address}'")
    page.get_by_role("button", name="Take over").click()
    page.get_by_role("group", name="Take over").get_by_role("button", name="Take over").click()
    expect(page.get_by_text("You have control.")).to_be_visible()
    return page


def one_of(jobs: list[dict[str, Any]], address: str) -> dict[str, Any]:
    return next(job for job in jobs if address.endswith(job["id"]))


def pass_of(number: int, **more: Any) -> dict[str, Any]:
    """What is different about a run of this pass of the older job."""
    first, second = ({**RUN["program"], "number": k, "name": name} for k, name in enumerate((FIRST, SECOND), 1))
    return {"program": second, "next": None} | ({"program": first, "next": second} if number == 1 else {}) | more


@pytest.mark.parametrize(
    ("run", "address", "words", "job", "program"),
    [
        (pass_of(1), "", "load the next program of astronaut, pass-2-finish.nc.", OWN, SECOND),
        (pass_of(1, state="aborted"), "", "load pass-1-rough.nc of astronaut.", OWN, FIRST),
        (pass_of(1), f"?job={OTHER}&program=1", "load pass-1-rough.nc of logo.", OTHER, FIRST),
        (pass_of(1), f"?job={OTHER}&program=2", "load pass-2-finish.nc of logo.", OTHER, SECOND),
        (pass_of(2), "", "the lens of astronaut is milled: take it out", OTHER, FIRST),
    ],
)
def test_the_program_that_is_named_is_the_one_that_is_loaded(
    opened: Opened, run: dict[str, Any], address: str, words: str, job: str, program: str
) -> None:
    """It follows the last run, or is what a person came with from a job's page: never one of another job unsaid."""
    page = shown(opened, run, address)
    expect(page.locator(".next .step")).to_contain_text(words)
    expect(page.get_by_role("combobox", name="Job")).to_have_value(job)
    expect(page.get_by_role("combobox", name="Program")).to_have_value(program)
    expect(page.locator(".running h2")).to_contain_text(f"{run['program']['name']} of astronaut")


def test_of_a_job_whose_programs_are_all_cut_none_is_chosen(opened: Opened) -> None:
    page = shown(opened, pass_of(2))
    programs = [{key: one[key] for key in RUN["program"]} for one in canned_job.job()["programs"]]
    cut = [RUN | {"state": "finished", "open": False, "program": program} for program in programs]
    page.route("**/v1/runs?machine=*&job=*", lambda route: route.fulfill(json={"runs": cut, "next": None}))
    page.get_by_role("combobox", name="Job").select_option(OWN)
    expect(page.get_by_role("combobox", name="Program").locator("option:checked")).to_have_text("all are done")
    expect(page.get_by_role("button", name="Load onto the mill")).to_be_disabled()
    expect(page.locator(".next .step")).to_contain_text("the lens of astronaut is milled")
    expect(page.locator(".primary:visible")).to_have_count(0)


@pytest.mark.thorough
def test_what_the_line_names_it_loads(opened: Opened) -> None:
    page = shown(opened, pass_of(1))
    asked: list[dict[str, Any]] = []

    def take(route: Route) -> None:
        asked.append(json.loads(route.request.post_data or "{}"))
        route.fulfill(status=201, json=RUN)

    page.route(f"**/v1/machines/{NAME}/runs", take)
    page.locator(".next").get_by_role("button", name="Load", exact=True).click()
    expect(page.locator(".next button:disabled")).to_have_count(0)
    assert asked == [{"job": OWN, "program": SECOND}]


def test_a_choice_is_named_and_done_with_once_it_is_on_the_mill(opened: Opened) -> None:
    page = shown(opened, pass_of(1), f"?job={OTHER}&program=2")
    step = page.locator(".next .step")
    expect(step).to_contain_text("load pass-2-finish.nc of logo.")
    page.get_by_role("combobox", name="Program").select_option(FIRST)
    expect(step).to_contain_text("load pass-1-rough.nc of logo.")
    page.get_by_role("combobox", name="Job").select_option(OWN)
    expect(step).to_contain_text("load pass-1-rough.nc of astronaut.")
    page.get_by_role("combobox", name="Job").select_option(OTHER)
    expect(step).to_contain_text("load pass-1-rough.nc of logo.")
    told(page, "parked", operator="Ada", run=pass_of(1, job=OTHER, job_name=NAMES[OTHER]))
    expect(page.locator(".running h2")).to_contain_text("pass-1-rough.nc of logo")
    assert page.evaluate("location.hash") == f"#/machines/{NAME}"


BEFORE = {"state": "finished", "open": False, "started_at": RUN["created_at"], "id": "an earlier one"}


def wait_after(page: Page, before: dict[str, Any], *, anew: str = "") -> None:
    """A program waits on a mill that another one has run on before; every zero is known, these axes' set since."""
    mill = {"needs": [], "zeroed_anew": anew}
    run = pass_of(1, id="a later one", travel_in_doubt=False, warnings=[])
    told(page, "parked", operator="Ada", mill=mill, run=run, before=RUN | BEFORE | before)


def test_the_zero_of_another_job_is_asked_for(opened: Opened) -> None:
    """X and Y, whether the block is the same one in the same place, which bars the start; Z is set anew in any case."""
    before = {"job": OTHER, "job_name": NAMES[OTHER], "operator": "Grace"}
    page = with_control(opened, "idle")
    wait_after(page, before)
    line = page.locator(".next")
    expect(line).to_contain_text("X0 Y0 was set for logo: is the same block clamped in the same place?")
    tick_all(page.locator(".checklist:visible"))
    page.get_by_label("Operator").fill("Ada")
    expect(page.locator(".checklist .missing")).to_have_text("Say above where X0 Y0 is.")
    go = page.get_by_role("button", name="Start pass-1-rough.nc")
    expect(go).to_be_disabled()
    line.get_by_role("button", name="Set again").click()
    expect(line.get_by_role("button", name="X and Y = 0 here")).to_be_enabled()
    expect(go).to_be_disabled()
    wait_after(page, before, anew="XY")
    expect(line).to_contain_text("set Z")
    expect(go).to_be_enabled()


@pytest.mark.thorough
def test_a_block_that_is_still_there_keeps_its_zero_in_x_and_y(opened: Opened) -> None:
    page = with_control(opened, "idle")
    wait_after(page, {"job": OTHER, "job_name": NAMES[OTHER]})
    line = page.locator(".next")
    line.get_by_role("button", name="Same place").click()
    expect(line.get_by_role("button", name="Z = 0 here")).to_be_enabled()


FOREIGN = """async ([mill, run, before]) =>
    (await import("/page/machine/place.js")).findForeignAxes({mill}, run, before)"""


def test_a_later_pass_of_the_same_job_keeps_the_zero(modules: Page) -> None:
    """So does a program that did not finish; a lens that is begun once more is another block."""

    def foreign(anew: str, number: int, **before: Any) -> str:
        last = None if not before else RUN | BEFORE | pass_of(1) | before
        run = RUN | {"program": RUN["program"] | {"number": number}}
        found: str = modules.evaluate(FOREIGN, [{"zeroed_anew": anew}, run, last])
        return found

    assert foreign("", 2, job=OWN) == foreign("", 1) == foreign("", 1, job=OWN, state="aborted") == ""
    assert foreign("", 1, job=OWN) == foreign("", 2, job=OTHER) == "XYZ"
    assert foreign("XY", 1, job=OTHER) == "Z"
    assert foreign("XYZ", 1, job=OTHER) == ""
