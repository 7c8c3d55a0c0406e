"""How urgent a job is: the words of the API and the numbers of the queue (smaller runs earlier)."""

from __future__ import annotations

PRIORITIES: dict[str, int] = {"high": 10, "normal": 100, "low": 1000}
NORMAL = PRIORITIES["normal"]


def priority_word(number: int) -> str:
    """The word nearest to a number of the queue."""
    return min(PRIORITIES, key=lambda word: abs(PRIORITIES[word] - number))
