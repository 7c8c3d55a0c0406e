"""Notifications to people elsewhere: a mill needs a hand, a program is finished, the next tool is due.

The mills are polled every few seconds, and each change since the last poll is reported once. A notification goes
to a web address as JSON or to a mailbox, in order, and is tried a few times.
"""

from __future__ import annotations

import asyncio
import smtplib
import ssl
import time
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import asdict, dataclass
from email.message import EmailMessage
from typing import Literal
from urllib.parse import unquote, urlsplit

import httpx
import structlog

from service.errors import printable
from service.server.database.records import FINISHED, INTERRUPTED, LOST
from service.server.database.runs import LIVE_WORDS
from service.server.fleet.fleet import Fleet
from service.server.schemas.runs import MachineView, RunView
from service.settings import ServerSettings

LOOK_S = 5.0
AGAIN_S = (2.0, 10.0, 60.0)
_WAIT_S = 10.0
_MOST_WAITING = 200
_RUNS = 100  # the newest runs, whose ends are reported
Event = Literal["needs_hand", "tool_change", "finished"]
_TROUBLE = {"alarm": "is locked by an alarm", "door": "its door is open", "tool": "waits for a tool change"}
_log = structlog.get_logger("api")


@dataclass(frozen=True, slots=True, kw_only=True)
class Notification:
    """at: Unix time [s]; run, program: empty where none is concerned."""

    machine: str
    event: Event
    words: str
    run: str = ""
    program: str = ""
    at: float


Send = Callable[[Notification], None]


class MillWatch:
    """Compares each poll of the mills and the newest runs with the one before."""

    def __init__(self, clock_s: Callable[[], float] = time.time) -> None:
        self._clock_s = clock_s
        self._troubles: dict[str, str] = {}  # by machine: the trouble last reported
        self._ended: set[str] | None = None  # runs that were finished at the last poll

    def compare(self, machines: Iterable[MachineView], runs: Iterable[RunView]) -> list[Notification]:
        """Return the new notifications. Programs that were finished before the first poll are not reported."""
        news = []
        for machine in machines:
            trouble = trouble_of(machine)
            if trouble and self._troubles.get(machine.name) != trouble:
                news.append(self._describe_trouble(machine, trouble))
            self._troubles[machine.name] = trouble
        finished = {run.id: run for run in runs if run.state == FINISHED and run.lift_mm is None}
        if self._ended is not None:
            news += [self._describe_end(run) for name, run in finished.items() if name not in self._ended]
        self._ended = set(finished)
        return news

    def _describe_trouble(self, machine: MachineView, words: str) -> Notification:
        run = machine.run
        about = {} if run is None else {"run": run.id, "program": run.program}
        words = f"{machine.name}: {words}"
        return Notification(machine=machine.name, event="needs_hand", words=words, at=self._clock_s(), **about)

    def _describe_end(self, run: RunView) -> Notification:
        done = f"{run.machine}: {run.program.name} is finished"
        return Notification(
            machine=run.machine,
            event="finished" if run.next is None else "tool_change",
            words=f"{done}." if run.next is None else f"{done}. Next: {run.next.name}; its tool is due.",
            run=run.id,
            program=run.program.name,
            at=self._clock_s(),
        )


def trouble_of(machine: MachineView) -> str:
    """Return why a mill needs a person, in words; nothing where it does not."""
    run, mill = machine.run, machine.mill or {}
    if not machine.agent.reachable:
        live = run is not None and run.state in LIVE_WORDS
        return f"out of reach while a program is on it ({machine.agent.words})" if live else ""
    if run is not None and run.state in (INTERRUPTED, LOST):
        return f"{run.program} was interrupted" + (f": {run.words}" if run.words else "")
    if mill.get("state") == "alarm" and run is None and not mill.get("alarm"):
        return ""  # switched on and not homed yet
    return _TROUBLE.get(mill.get("state", ""), "")


async def watch_mills(fleet: Fleet, send: Callable[[Notification], Awaitable[None]]) -> None:
    """Send notifications until the server ends. A failed poll is skipped."""
    watch = MillWatch()
    while True:
        try:
            runs = await fleet.list_runs(machine=None, job=None, limit=_RUNS, before=None)
            for one in watch.compare((await fleet.list_machines()).machines, runs):
                await send(one)
        except Exception as error:  # the database is away, or an agent sent invalid data
            _log.warning("mills were not looked at", error=printable(str(error))[:200])
        if await fleet.await_end(LOOK_S):
            return


class Delivery:
    """One queue for each channel, so that a mailbox that is away does not delay the web address."""

    def __init__(self, ways: dict[str, Send], *, again_s: tuple[float, ...] = AGAIN_S) -> None:
        self._ways, self._again_s = ways, again_s
        self._queues: dict[str, asyncio.Queue[Notification]] = {way: asyncio.Queue(_MOST_WAITING) for way in ways}

    async def enqueue(self, notification: Notification) -> None:
        """Queue a notification; if the queue is full, the oldest one is given up."""
        for way, queue in self._queues.items():
            if queue.full():
                _log.warning("a notification was given up", way=way, words=queue.get_nowait().words)
            queue.put_nowait(notification)

    async def run(self) -> None:
        """Send notifications until cancelled."""
        await asyncio.gather(*(self._run(way) for way in self._ways))

    async def _run(self, way: str) -> None:
        while True:
            await self._send(way, await self._queues[way].get())

    async def _send(self, way: str, notification: Notification) -> None:
        for wait_s in (*self._again_s, None):
            try:
                await asyncio.to_thread(self._ways[way], notification)
                return
            except Exception as error:  # the other side may fail in any way: the mills go on
                words = printable(str(error) or type(error).__name__)[:200]
                _log.warning("a notification was not sent", way=way, error=words, again_s=wait_s)
            if wait_s is not None:
                await asyncio.sleep(wait_s)


def list_ways_out(settings: ServerSettings) -> dict[str, Send]:
    """Return the channels that are configured."""
    ways: dict[str, Send] = {}
    if url := settings.notify_url:
        ways["webhook"] = lambda notification: post(url, notification)
    if mailbox := settings.notify_email:
        ways["e-mail"] = lambda notification: mail(settings.smtp_url, mailbox, notification)
    return ways


def post(url: str, notification: Notification) -> None:
    """POST it as JSON. httpx.HTTPError if it is not taken."""
    httpx.post(url, json=asdict(notification), timeout=_WAIT_S).raise_for_status()


def mail(smtp_url: str, mailbox: str, notification: Notification) -> None:
    """Send it through smtp://user:password@host:port, encrypted where the server can, or smtps://. OSError,
    SMTPException.
    """
    address = urlsplit(smtp_url)
    message = EmailMessage()
    message["From"] = message["To"] = mailbox
    message["Subject"] = " ".join(notification.words.split())[:200]
    message.set_content(notification.words)
    host, context = address.hostname or "localhost", ssl.create_default_context()
    server = (
        smtplib.SMTP_SSL(host, address.port or 465, timeout=_WAIT_S, context=context)
        if address.scheme == "smtps"
        else smtplib.SMTP(host, address.port or 587, timeout=_WAIT_S)
    )
    with server:
        if address.scheme == "smtp" and server.ehlo()[0] == 250 and server.has_extn("starttls"):
            server.starttls(context=context)
        if address.username:
            server.login(unquote(address.username), unquote(address.password or ""))
        server.send_message(message)
