"""Waiting in tests, in one place: for what must become true, as long as the busiest computer may need.

No test passes or fails by how fast a computer is: PATIENCE_S ends only what hangs. Where a law is itself about time
("before the lease ends"), its test gives the bound, and the bound is far from both right and wrong.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

Seen = TypeVar("Seen")

PATIENCE_S = 300.0
PATIENCE_MS = 1000 * PATIENCE_S


def until(true: Callable[[], object], *, what: str = "this", within_s: float = PATIENCE_S) -> float:
    """Wait for something that must become true; the seconds that it took."""
    begun_s = time.monotonic()
    seen(true, bool, what=what, within_s=within_s)
    return time.monotonic() - begun_s


def seen(
    look: Callable[[], Seen],
    good: Callable[[Seen], object],
    *,
    what: str = "",
    within_s: float = PATIENCE_S,
    every_s: float = 0.01,
) -> Seen:
    """Look until what is seen is good; that. Where it never is, `what` is told, or what was seen last."""
    give_up_s = time.monotonic() + within_s
    while not good(found := look()):
        assert time.monotonic() < give_up_s, f"not within {within_s:g} s: {what or found}"
        time.sleep(every_s)
    return found
