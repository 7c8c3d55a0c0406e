"""Notifications on their way out: to a web address as JSON, to a mailbox. Tried a few times, in order."""

from __future__ import annotations

import asyncio
import smtplib
import ssl
from collections.abc import Callable
from dataclasses import asdict
from email.message import EmailMessage
from urllib.parse import unquote, urlsplit

import httpx
import structlog

from service.errors import printable
from service.server.fleet.notifications import Notification
from service.settings import ServerSettings

AGAIN_S = (2.0, 10.0, 60.0)
_WAIT_S = 10.0
_MOST_WAITING = 200
_log = structlog.get_logger("api")

Send = Callable[[Notification], None]


class Delivery:
    """One queue for each way out, so that a mailbox that is away keeps nothing from the web address."""

    def __init__(self, ways: dict[str, Send], *, again_s: tuple[float, ...] = AGAIN_S) -> None:
        self._ways, self._again_s = ways, again_s
        self._queues: dict[str, asyncio.Queue[Notification]] = {way: asyncio.Queue(_MOST_WAITING) for way in ways}

    async def tell(self, notification: Notification) -> None:
        """Take it; the oldest that waits is given up for it where too many do."""
        for way, queue in self._queues.items():
            if queue.full():
                _log.warning("a notification was given up", way=way, words=queue.get_nowait().words)
            queue.put_nowait(notification)

    async def run(self) -> None:
        """Send what comes, until cancelled."""
        await asyncio.gather(*(self._run(way) for way in self._ways))

    async def _run(self, way: str) -> None:
        while True:
            await self._send(way, await self._queues[way].get())

    async def _send(self, way: str, notification: Notification) -> None:
        for wait_s in (*self._again_s, None):
            try:
                await asyncio.to_thread(self._ways[way], notification)
                return
            except Exception as error:  # whatever the other side does: the mills go on
                words = printable(str(error) or type(error).__name__)[:200]
                _log.warning("a notification was not sent", way=way, error=words, again_s=wait_s)
            if wait_s is not None:
                await asyncio.sleep(wait_s)


def ways_out(settings: ServerSettings) -> dict[str, Send]:
    """Return the ways that are set up."""
    ways: dict[str, Send] = {}
    if url := settings.notify_url:
        ways["webhook"] = lambda notification: post(url, notification)
    if mailbox := settings.notify_email:
        ways["e-mail"] = lambda notification: mail(settings.smtp_url, mailbox, notification)
    return ways


def post(url: str, notification: Notification) -> None:
    """POST it as JSON. httpx.HTTPError where it is not taken."""
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
