"""What has happened to a mill, for whoever looks: the latest entries, numbered."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from machines.mill.orders import NOBODY, Caller
from machines.mill.view import LogEntry

LOG_ENTRIES = 200


class MillLog:
    """Entries of the last while. `wall_clock` gives seconds since 1970."""

    def __init__(self, wall_clock: Callable[[], float]) -> None:
        self._wall = wall_clock
        self._entries: deque[LogEntry] = deque(maxlen=LOG_ENTRIES)
        self.count = 0

    def say(self, kind: str, words: str, answer: dict[str, object] | None = None, caller: Caller = NOBODY) -> None:
        self.count += 1
        at_s = round(self._wall(), 3)
        self._entries.append(LogEntry(self.count, at_s, kind, words, dict(answer or {}), caller.name, caller.origin))

    def after(self, known: tuple[LogEntry, ...]) -> tuple[LogEntry, ...]:
        """All entries; the very tuple that is known already where nothing was added."""
        return known if known and known[-1].number == self.count else tuple(self._entries)
