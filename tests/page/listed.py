"""Lists of jobs that need no worker, told to a page in place of what its server says."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page, Route


def summary(number: int, state: str, **more: Any) -> dict[str, Any]:
    """A job as the API lists it."""
    address = f"/v1/jobs/00000000-0000-4000-8000-{number:012d}"
    links = {"self": address, "events": f"{address}/events", "artifacts": f"{address}/artifacts"}
    body = {
        "id": address.rpartition("/")[2], "name": f"picture-{number}.png", "state": state, "stage": None,
        "progress": 0.42, "queue_position": None, "priority": "normal", "attempt": 1, "cancel_requested": False,
        "created_at": f"2026-11-21T08:{59 - number:02d}:00.000Z", "started_at": None, "ended_at": None, "error": None,
        "image": {"sha256": "0" * 64, "bytes": 1}, "lens_mm": [60.0, 40.0], "machine": "grbl",
        "hours": 1.5, "links": links, "etag": f'"{number}-{state}"',
    }  # fmt: skip
    return body | more


def answer_with(page: Page, jobs: list[dict[str, Any]]) -> None:
    """The server of this page has just these jobs, and no files of them."""

    def answer_list(route: Route) -> None:
        route.fulfill(json={"jobs": [job for job in jobs if _asked(route, job["state"])], "next": None})

    page.route("**/v1/jobs?*", answer_list)
    page.route("**/v1/jobs/*/artifacts", lambda route: route.fulfill(json={"artifacts": []}))


def _asked(route: Route, state: str) -> bool:
    wanted = [part.removeprefix("state=") for part in route.request.url.split("?")[1].split("&") if "state=" in part]
    return not wanted or state in wanted
