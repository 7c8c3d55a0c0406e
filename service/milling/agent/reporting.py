"""Reports events at the mill: to the readers of the event stream, and to a file that lasts longer than the log's ring.

A thread watches the mill's thread and hands snapshots to the event loop at most five times a second. The file records
who ordered what, when, from where, and with what result: lines of JSON beside the journal, numbered across restarts.
Another thread writes it, so that neither the mill nor its readers wait for this disk. The oldest file is deleted when
there are `_MOST_FILES`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from machines.mill.thread import MillThread
from machines.mill.view import LogEntry, MillSnapshot
from service.http.event_hub import Hub, Reader

_KINDS = frozenset({"order", "command", "run", "fault", "link"})
_FILE_BYTES = 4 << 20
_MOST_FILES = 20

Json = dict[str, Any]


class AuditLog:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._entries: queue.SimpleQueue[LogEntry | None] = queue.SimpleQueue()
        self._number = self._last_number()
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
        self._thread.start()

    def note(self, entry: LogEntry) -> None:
        """Queue a note to be written; never waits."""
        if entry.kind in _KINDS:
            self._entries.put(entry)

    def read(self, before: int, limit: int) -> list[Json]:
        """Return the newest entries with numbers below `before`, newest first."""
        found: list[Json] = []
        for entry in self._newest_first():
            if entry["number"] < before:
                found.append(entry)
                if len(found) == limit:
                    break
        return found

    def close(self) -> None:
        self._entries.put(None)
        self._thread.join(5.0)

    def _run(self) -> None:
        while (entry := self._entries.get()) is not None:
            self._number += 1
            line = json.dumps({**entry.as_dict(), "number": self._number}, separators=(",", ":"))
            with contextlib.suppress(OSError):  # a full disk: the journal reports that, and holds the mill
                self._append(line)

    def _append(self, line: str) -> None:
        paths = self._paths()
        path = paths[-1] if paths and paths[-1].stat().st_size < _FILE_BYTES else self._new_path()
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "a", encoding="utf-8") as file:
            file.write(line + "\n")
        for old in paths[: -_MOST_FILES + 1]:
            old.unlink(missing_ok=True)

    def _new_path(self) -> Path:
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return self._folder / f"orders-{self._number:012d}.jsonl"

    def _paths(self) -> list[Path]:
        """Return the paths, oldest first."""
        return sorted(self._folder.glob("orders-*.jsonl"))

    def _newest_first(self) -> Iterator[Json]:
        for path in reversed(self._paths()):
            with contextlib.suppress(OSError):
                for line in reversed(path.read_text(encoding="utf-8", errors="replace").splitlines()):
                    with contextlib.suppress(ValueError):  # torn by a power cut
                        entry = json.loads(line)
                        if isinstance(entry, dict) and isinstance(entry.get("number"), int):
                            yield entry

    def _last_number(self) -> int:
        return next((int(entry["number"]) for entry in self._newest_first()), 0)


_WAIT_S = 1.0
_LEAST_GAP_S = 0.2


class SnapshotFeed:
    """A thread that waits for changes and hands snapshots to the event loop, which sends them to the readers."""

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
                self._loop.call_soon_threadsafe(self._publish, snapshot)
            except RuntimeError:  # the loop has ended
                return
            self._ended.wait(_LEAST_GAP_S)

    def _publish(self, snapshot: MillSnapshot) -> None:
        """Publish on the event loop: first the new events, then the state."""
        for entry in snapshot.events:
            if entry.number > self._last_event:
                self._last_event = entry.number
                self._hub.publish_event(entry.as_dict())
                self._audit.note(entry)
        self._hub.publish_status(status_of(snapshot))


def status_of(snapshot: MillSnapshot) -> dict[str, object]:
    """Return the snapshot without its events, which are sent one by one."""
    return {key: value for key, value in snapshot.as_dict().items() if key != "events"}
