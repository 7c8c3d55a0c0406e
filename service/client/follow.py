"""Follow a job to its end, through lost connections and restarts of the server. Events are server-sent;
after a lost connection the reader reconnects with Last-Event-ID and misses nothing.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from service.client.jobs import state_words
from service.client.server import GoneError, RefusedError, ServerClient, clean
from service.errors import EXIT_INTERRUPTED, FailedError, ServiceError, printable
from service.progress import PlainReporter, QuietReporter, Reporter, TerminalReporter

ENDED = ("succeeded", "failed", "cancelled")
_SILENCE_S = 45.0  # the server sends a comment every 15 s
_LOST_S = 600.0
_AGAIN_S = (0.1, 0.3, 1.0, 2.0, 3.0)
_PASSING = {429, 502, 503, 504}


@dataclass(frozen=True, slots=True)
class ServerEvent:
    """One message; `id` is empty if it cannot be resumed from."""

    kind: str
    data: dict[str, Any]
    id: str = ""


def parse_events(lines: Iterable[str]) -> Iterator[ServerEvent]:
    """Yield the messages in the lines of an event stream; skip a message whose data is not a JSON object."""
    fields: dict[str, str] = {}
    for line in lines:
        if line.startswith(":"):
            continue
        if line:
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            fields[name] = f"{fields[name]}\n{value}" if name == "data" and "data" in fields else value
            continue
        if "data" in fields and (data := _object(fields["data"])) is not None:
            yield ServerEvent(fields.get("event", "message"), data, fields.get("id", ""))
        fields = {}


def stream_events(
    server: ServerClient,
    path: str,
    *,
    on_lost: Callable[[str], None],
    on_back: Callable[[], None],
) -> Iterator[ServerEvent | None]:
    """Yield messages until the server has no more (204). None: the connection is new, ask for the present state.

    `on_lost` is called once for each lost connection; GoneError if the server does not return within ten minutes.
    """
    last_id, tries, lost_s = "", 0, None
    while True:
        try:
            headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": last_id} if last_id else {})
            with server.stream_answer(path, headers=headers, read_s=_SILENCE_S) as answer:
                server.raise_for_status(answer)
                if lost_s is not None:
                    on_back()
                    lost_s = None
                yield None
                if answer.status_code == 204:
                    return
                for event in parse_events(answer.iter_lines()):
                    tries, last_id = 0, event.id or last_id
                    yield event
            words = ""
        except (GoneError, RefusedError) as error:
            if isinstance(error, RefusedError) and error.status not in _PASSING:
                raise
            words = str(error)
            now_s = time.monotonic()
            if lost_s is None:
                lost_s = now_s
                on_lost(words)
            if now_s - lost_s > _LOST_S:
                raise
        time.sleep(_AGAIN_S[min(tries, len(_AGAIN_S) - 1)])
        tries += 1


def _object(text: str) -> dict[str, Any] | None:
    try:
        data = json.loads(text)
    except ValueError:
        return None
    return data if isinstance(data, dict) else None


class LeftError(ServiceError):
    """Ctrl-C: this command ends; the job or run that it watched goes on."""

    exit_code = EXIT_INTERRUPTED


def follow(server: ServerClient, job_id: str, screen: JobScreen) -> dict[str, Any]:
    """Follow the job; return its final state."""
    with explain_interrupt(f"the job goes on; `causticmill jobs follow {job_id}` shows it, `jobs cancel` ends it"):
        events = stream_events(
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
    """Raise FailedError with the server's words unless the job has succeeded."""
    job_id = clean(job["id"])
    if job["state"] == "failed":
        error = job.get("error") or {}
        where = f" in stage {clean(error['stage'])}" if error.get("stage") else ""
        lines = str(error.get("detail") or "no reason given").split("\n")
        raise FailedError(f"job {job_id} failed{where}: {lines[0]}", *lines[1:])
    if job["state"] == "cancelled":
        raise FailedError(f"job {job_id} was cancelled; `causticmill jobs retry {job_id}` starts it again")


@contextlib.contextmanager
def explain_interrupt(words: str) -> Iterator[None]:
    """Print on Ctrl-C what happens to the job or run that was watched."""
    try:
        yield
    except KeyboardInterrupt:
        raise LeftError(words) from None


@dataclass(slots=True)
class JobScreen:
    """Shows each stage of a job once, from its events in the server's order."""

    reporter: Reporter
    quiet: bool
    _begun: set[str] = field(default_factory=set)

    def say(self, line: str) -> None:
        if not self.quiet:
            print(printable(line), flush=True)  # rich moves its bars out of the way

    def take(self, kind: str, data: dict[str, Any]) -> None:
        stage = clean(data.get("stage", ""))
        match kind:
            case "stage.started":
                self._begin(stage)
            case "progress" if stage in self._begun:
                self.reporter.report_share(stage, _number(data.get("share")))
            case "stage.committed":
                self._begin(stage)
                self._begun.discard(stage)
                self.reporter.end_stage(stage, _number(data.get("seconds")))
            case "stage.reused":
                self.say(f"{stage}: reused from an earlier job or attempt")
            case "stage.interrupted":
                self._begun.discard(stage)
                self.say(f"{stage}: interrupted, it will be done again")
            case "cancel.requested":
                self.say("cancelling ...")

    def _begin(self, stage: str) -> None:
        if stage not in self._begun:
            self._begun.add(stage)
            self.reporter.start_stage(stage)


@contextlib.contextmanager
def job_screen(*, quiet: bool) -> Iterator[JobScreen]:
    if quiet:
        yield JobScreen(QuietReporter(), quiet=True)
    elif sys.stdout.isatty():
        from rich.console import Console

        with TerminalReporter(Console()) as bars:
            yield JobScreen(bars, quiet=False)
    else:
        yield JobScreen(PlainReporter(sys.stdout), quiet=False)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else 0.0
