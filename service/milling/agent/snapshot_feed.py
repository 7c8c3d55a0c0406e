"""Carries what the mill's thread tells to the readers of the event stream, at most five times a second."""

from __future__ import annotations

import asyncio
import threading

from machines.mill.thread import MillThread
from machines.mill.view import MillSnapshot
from service.http.event_hub import Hub, Reader
from service.milling.agent.audit import AuditLog

_WAIT_S = 1.0
_LEAST_GAP_S = 0.2


class SnapshotFeed:
    """A thread that waits for changes and hands snapshots to the event loop, which tells the readers."""

    def __init__(self, thread: MillThread, loop: asyncio.AbstractEventLoop, hub: Hub[Reader], audit: AuditLog) -> None:
        self._thread = thread
        self._loop = loop
        self._hub = hub
        self._audit = audit
        self._last_event = 0
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        self._watcher.start()

    def stop(self) -> None:
        self._ended.set()

    def _run(self) -> None:
        version = -1
        while not self._ended.is_set():
            snapshot = self._thread.wait_for_change(version, _WAIT_S)
            if snapshot.version == version:
                continue
            version = snapshot.version
            try:
                self._loop.call_soon_threadsafe(self._tell, snapshot)
            except RuntimeError:  # the loop has ended
                return
            self._ended.wait(_LEAST_GAP_S)

    def _tell(self, snapshot: MillSnapshot) -> None:
        """Publish on the event loop: first what has happened since, then how things stand."""
        for entry in snapshot.events:
            if entry.number > self._last_event:
                self._last_event = entry.number
                self._hub.publish_event(entry.as_dict())
                self._audit.note(entry)
        self._hub.publish_status(status_of(snapshot))


def status_of(snapshot: MillSnapshot) -> dict[str, object]:
    """Return the snapshot without its events, which go out one by one."""
    return {key: value for key, value in snapshot.as_dict().items() if key != "events"}
