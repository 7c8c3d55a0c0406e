"""Jobs as lines of text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Any

from service.client.server import ServerClient, clean
from service.wording import align

_PAGE = 100


def list_jobs(server: ServerClient, *, states: Sequence[str] = (), limit: int = 20) -> Iterator[dict[str, Any]]:
    """Yield jobs, newest first, page by page."""
    asked: dict[str, Any] = {"limit": min(limit, _PAGE)} | ({"state": list(states)} if states else {})
    address, left = "/v1/jobs", limit
    while left > 0:
        page = server.get(address, **asked)
        yield from page["jobs"][:left]
        left -= len(page["jobs"])
        address, asked = page.get("next") or "", {}
        if not address:
            return


def job_table(jobs: Sequence[dict[str, Any]]) -> list[str]:
    rows = [("ID", "STATE", "DONE", "CREATED", "NAME")]
    rows += [
        (
            clean(job["id"]),
            state_words(job),
            f"{100 * float(job['progress']):.0f} %",
            when(job["created_at"]),
            clean(job["name"]),
        )
        for job in jobs
    ]
    return align(rows) if jobs else ["no jobs"]


def state_words(job: dict[str, Any]) -> str:
    """Return the state in words: running (pass-1), queued (3 before it), cancelling, ..."""
    state = clean(job["state"])
    if job.get("cancel_requested") and state == "running":
        return "cancelling"
    if state == "running" and job.get("stage"):
        return f"running ({clean(job['stage'])})"
    if state == "queued" and int(job.get("queue_position") or 1) > 1:
        return f"queued ({int(job['queue_position']) - 1} before it)"
    return state


def job_lines(job: dict[str, Any]) -> list[str]:
    """Return one job, in full."""
    lines = [f"{clean(job['id'])}  {clean(job['name'])}", f"state:    {state_words(job)}"]
    lines += [f"{name + ':':9} {when(job[key])}" for name, key in _TIMES if job.get(key)]
    if job.get("attempt", 1) > 1:
        lines.append(f"attempt:  {job['attempt']}")
    if error := job.get("error"):
        where = f"in stage {clean(error['stage'])}: " if error.get("stage") else ""
        lines += [f"error:    {where}{clean(line)}" for line in str(error.get("detail", "")).split("\n")]
    stages = [(clean(stage["name"]), clean(stage["state"]), _seconds(stage)) for stage in job.get("stages") or ()]
    lines += ["", *align([("STAGE", "STATE", "TOOK"), *stages])] if stages else []
    return [*lines, *program_lines(job)]


def program_lines(job: dict[str, Any]) -> list[str]:
    programs = job.get("programs") or ()
    rows = [(str(p["number"]), clean(p["name"]), f"{p['bytes']:,} bytes", clean(p["sha256"])) for p in programs]
    return ["", *align([("PROGRAM", "FILE", "SIZE", "SHA-256"), *rows])] if rows else []


def when(text: object) -> str:
    """Return a server's time, such as 2026-11-21T08:00:00.123Z, in local time with its offset."""
    try:
        return datetime.fromisoformat(str(text)).astimezone().isoformat(" ", "seconds") if text else ""
    except (ValueError, OverflowError, OSError):
        return clean(text)


def _seconds(stage: dict[str, Any]) -> str:
    seconds = stage.get("seconds")
    return f"{seconds:.1f} s" if isinstance(seconds, int | float) else ""


_TIMES = (("created", "created_at"), ("started", "started_at"), ("ended", "ended_at"))
