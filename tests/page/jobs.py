"""Jobs for the page that need no worker: the stub's own job, with another state, report or spec."""

from __future__ import annotations

import copy
import math
from typing import Any

from playwright.sync_api import Page, Route, expect

from tests.page import canned_job
from tests.page.browser import open_blank
from tests.page.conftest import Opened

FAKE = "00000000-0000-4000-8000-{:012d}"
PLAN_HOURS = (0.2, 0.5, 1.0, 4.0, 9.0)


def canned() -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The finished job of the stub and its files, as the API tells them."""
    return canned_job.job(), canned_job.artifacts()


def like(job: dict[str, Any], number: int, **changes: Any) -> dict[str, Any]:
    """Another job with this one's values but for the changes; files stay at the first one's addresses."""
    return copy.deepcopy(job) | {"id": FAKE.format(number)} | changes


def stopped_at(job: dict[str, Any], stage: str, state: str) -> list[dict[str, Any]]:
    """Its stages, as if one had ended so and the others had not begun."""
    names = [each["name"] for each in job["stages"]]
    at = names.index(stage)
    words = ["committed"] * at + [state] + ["waiting"] * (len(names) - at - 1)
    return [each | {"state": word} for each, word in zip(job["stages"], words, strict=True)]


def answer(page: Page, job: dict[str, Any], files: list[dict[str, Any]]) -> None:
    """The server of this page has this job, too."""
    address = f"**/v1/jobs/{job['id']}"
    page.route(address, lambda route: _told(route, job))
    page.route(f"{address}/artifacts", lambda route: route.fulfill(json={"artifacts": files}))
    page.route(f"{address}/events", lambda route: route.fulfill(status=204))


def _told(route: Route, job: dict[str, Any]) -> None:
    if route.request.method == "GET":
        route.fulfill(json=job)
    else:
        route.fallback()


def shown(opened: Opened, job: dict[str, Any], files: list[dict[str, Any]], **how: Any) -> Page:
    """The view of such a job."""
    page = open_blank(opened, "job", **how)
    answer(page, job, files)
    page.evaluate("id => { location.hash = `#/jobs/${id}` }", job["id"])
    expect(page.get_by_role("heading", level=1, name=job["name"].removesuffix(".png"), exact=True)).to_be_visible()
    unfold(page)
    return page


def unfold(page: Page) -> None:
    """Open every part of a job's page."""
    expect(page.locator(".folded")).not_to_have_count(0)
    page.evaluate("for (const one of document.querySelectorAll('.folded > details')) one.open = true")


def with_plan(job: dict[str, Any], number: int, chosen: int = 2) -> dict[str, Any]:
    """A job whose passes were planned, with some plans to choose from."""
    plan = canned_job.plan()
    first = plan["candidates"][0]
    rows = [
        first | {
            "hours": hours, "hours_by_pass": [hours / 4, 3 * hours / 4], "psnr_db": 20.0 + at,
            "seen_db": 8.0 + at, "ssim": 0.5 + at / 20,
            "blur_mm": 0.8 / (at + 1), "blur_px": 4.0 / (at + 1), "words": f"ball {at}",
            "warning": None if at else "fine hair is lost",
            "spec": first["spec"] | {"passes": [row | {"pitch_mm": 0.5 / (at + 1)} for row in first["spec"]["passes"]]},
        }
        for at, hours in enumerate(PLAN_HOURS)
    ]  # fmt: skip
    plan |= {key: rows[chosen][key] for key in ("hours", "psnr_db", "seen_db", "blur_mm")} | {
        "chosen": chosen,
        "candidates": rows,
    }
    return like(job, number, report=job["report"] | {"plan": plan})


def alike(seen_db: float) -> str:
    """How the page words a likeness."""
    percent = 100 * (1 - 10 ** (-seen_db / 10))
    digits = 0 if percent < 97 else 1 if percent < 99.7 else 2
    return f"{math.floor(percent * 10**digits) / 10**digits:g} % alike"
