"""Server-sent events that outlast a lost connection: the reader comes back with Last-Event-ID and misses nothing."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from service.client.server import GoneError, RefusedError, ServerClient

_SILENCE_S = 45.0  # the server sends a comment every 15 s
_AGAIN_S = (0.1, 0.3, 1.0, 2.0, 3.0)
_PASSING = {429, 502, 503, 504}


@dataclass(frozen=True, slots=True)
class ServerEvent:
    """One message; `id` is empty where it cannot be resumed from."""

    kind: str
    data: dict[str, Any]
    id: str = ""


def parse_events(lines: Iterable[str]) -> Iterator[ServerEvent]:
    """Yield the messages in the lines of an event stream; one whose data is no JSON object is passed over."""
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
    timeout_s: float = 600.0,
) -> Iterator[ServerEvent | None]:
    """Yield messages until the server has no more (204). None: the connection is new, ask for the present state.

    `on_lost` is told once for each time the connection is lost; GoneError when it stays away for `timeout_s`.
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
            if now_s - lost_s > timeout_s:
                raise
        time.sleep(_AGAIN_S[min(tries, len(_AGAIN_S) - 1)])
        tries += 1


def _object(text: str) -> dict[str, Any] | None:
    try:
        data = json.loads(text)
    except ValueError:
        return None
    return data if isinstance(data, dict) else None
