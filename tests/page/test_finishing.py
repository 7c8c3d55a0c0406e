"""The work by hand on the view of a job: what to do, for how long, when to stop, and what the wall shows then."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from service.job.spec.finish_library import built_in_processes, instruct_finishing
from tests.page import jobs
from tests.page.browser import layout_faults, serious_faults
from tests.page.conftest import Opened
from tests.page.jobs import alike

SEEN = {"psnr_db": 28.4, "seen_db": 18.0, "ssim": 0.81, "misplaced_light": 0.03, "smallest_detail_mm": 1.13}
PROCESSES = built_in_processes()


def finished(
    opened: Opened,
    number: int,
    *,
    seen: dict[str, Any] = SEEN,
    how: dict[str, Any],
    rims: str | None = None,
    **given: Any,
) -> Page:
    """The view of the canned job, finished by hand, its picture prepared."""
    job, files = jobs.canned()
    told = instruct_finishing(how, PROCESSES, area_mm2=2500.0)
    report = job["report"] | {"as_finished": seen, "finishing": told, "rim_room": {"advice": rims}}
    names = {"caustic-as-milled.png": "caustic-as-finished.png", "tolerances.png": "prepared.png"}
    files += [one | {"name": names[one["name"]]} for one in files if one["name"] in names]
    return jobs.shown(opened, jobs.like(job, number, report=report), files, **given)


def test_the_card_leads_through_the_finish(opened: Opened) -> None:
    page = finished(opened, 41, how={"process": "felt"})
    card = page.get_by_role("region", name="Finishing by hand: Polishing with felt and compound")
    process = PROCESSES["felt"]
    for sentence in (*process.needs, *process.steps, *process.donts, process.removal, process.when_to_stop):
        expect(card).to_contain_text(sentence)
    expect(card).to_contain_text("10 min")  # a quarter of 100 cm2
    expect(card).to_contain_text(alike(SEEN["seen_db"]))
    expect(card.locator(".notice")).to_have_count(0)
    facts = page.locator(".expect-part")
    expect(facts).to_contain_text("On the wall, as finished")
    expect(facts).to_contain_text("details under 1.1 mm will blur")
    page.locator("#pictures-title").scroll_into_view_if_needed()
    expect(page.get_by_role("slider", name="Wipe between Target and As finished")).to_be_visible()
    expect(page.get_by_role("img", name="As given and prepared")).to_be_visible()
    facts.get_by_text("Figures for experts").click()
    likeness = page.get_by_role("row", name="Likeness (PSNR)").get_by_role("cell")
    expect(likeness.first).to_have_text("28.4 dB")


def test_the_tool_that_the_rims_want_is_said(opened: Opened) -> None:
    page = finished(opened, 45, how={"process": "felt"}, rims="On the outermost 4.0 mm work with a smaller tool.")
    expect(page.locator(".finishing-part")).to_contain_text("On the outermost 4.0 mm work with a smaller tool.")


def test_what_speaks_against_a_finish_is_said(opened: Opened) -> None:
    page = finished(opened, 42, seen={**SEEN, "psnr_db": 3.0}, how={"process": "sanding", "minutes": 0.5})
    notices = page.locator(".finishing-part .notice")
    expect(notices).to_have_count(2)
    expect(notices.first).to_contain_text("makes the picture worse")
    expect(notices.last).to_contain_text("is outside the known range")


def test_a_job_without_a_finish_has_no_card(opened: Opened) -> None:
    page = finished(opened, 43, how={"process": "none"})
    expect(page.get_by_role("heading", name="Programs")).to_be_visible()
    expect(page.locator(".finishing-part")).to_be_hidden()


@pytest.mark.thorough
@pytest.mark.parametrize(("size", "scheme"), [("wide", "light"), ("phone", "dark")])
def test_the_card_fits_and_can_be_read_by_everybody(
    opened: Opened, picture: Callable[[Page, str], Path | None], size: str, scheme: str
) -> None:
    page = finished(opened, 44, how={"process": "lacquer"}, size=size, scheme=scheme)
    for part in ("#lens-title", "#path-title", "#files-title"):
        page.locator(part).scroll_into_view_if_needed()
    expect(page.locator("[data-level]")).to_be_attached()
    assert layout_faults(page) == []
    assert serious_faults(page) == []
    picture(page, f"finishing-{size}")
