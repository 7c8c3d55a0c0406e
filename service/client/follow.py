"""Follow a job to its end, through lost connections and restarts of the server."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from service.client.event_stream import lasting
from service.client.job_screen import JobScreen
from service.client.jobs import state_words
from service.client.server import Server, shown
from service.errors import EXIT_INTERRUPTED, FailedError, JobError

ENDED = ("succeeded", "failed", "cancelled")


class LeftError(JobError):
    """Ctrl-C: this command ends, what it watched goes on."""

    exit_code = EXIT_INTERRUPTED


def follow(server: Server, job_id: str, screen: JobScreen) -> dict[str, Any]:
    """The job as it is at its end."""
    with leaving(f"the job goes on; `causticmill jobs follow {job_id}` shows it, `jobs cancel` ends it"):
        events = lasting(
            server,
            f"/v1/jobs/{job_id}/events",
            on_lost=lambda words: screen.say(f"{words}; trying again, the job goes on"),
            on_back=lambda: screen.say("connected again"),
        )
        for event in events:
            if event is not None:
                screen.take(event.kind, event.data)
            if event is None or event.kind == "ended":
                job = server.get(f"/v1/jobs/{job_id}")
                if job["state"] in ENDED:
                    return dict(job)
                if job["state"] == "queued":
                    screen.say(state_words(job))
        return dict(server.get(f"/v1/jobs/{job_id}"))


def require_success(job: dict[str, Any]) -> None:
    """FailedError, in the words of the server, unless the job has succeeded."""
    job_id = shown(job["id"])
    if job["state"] == "failed":
        error = job.get("error") or {}
        where = f" in stage {shown(error['stage'])}" if error.get("stage") else ""
        lines = str(error.get("detail") or "no reason given").split("\n")
        raise FailedError(f"job {job_id} failed{where}: {lines[0]}", *lines[1:])
    if job["state"] == "cancelled":
        raise FailedError(f"job {job_id} was cancelled; `causticmill jobs retry {job_id}` starts it again")


@contextlib.contextmanager
def leaving(words: str) -> Iterator[None]:
    """Ctrl-C inside says what becomes of the thing watched."""
    try:
        yield
    except KeyboardInterrupt:
        raise LeftError(words) from None
