"""Who ordered what, when, from where, and what came of it: a file beside the journal that outlives the ring of the log.

Lines of JSON, each with a number that goes on across starts. A thread of its own writes, so that neither the mill nor
its readers wait for this disk; the oldest file goes when there are `_MOST_FILES`.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from machines.mill.view import LogEntry

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
            with contextlib.suppress(OSError):  # a full disk: the journal says so, and holds the mill
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
