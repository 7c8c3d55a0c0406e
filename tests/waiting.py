"""Waiting in tests, in one place: for what must become true, as long as the busiest computer may need.

No test passes or fails by how fast a computer is: PATIENCE_S ends only what hangs. Where a law is itself about time
("before the lease ends"), its test gives the bound, and the bound is far from both right and wrong.
"""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 300.0
PATIENCE_MS = 1000 * PATIENCE_S


def until(true: Callable[[], object], *, what: str = "this", within_s: float = PATIENCE_S) -> float:
    """Wait for something that must become true; the seconds that it took."""
    begun_s = time.monotonic()
    while not true():
        assert time.monotonic() < begun_s + within_s, f"not within {within_s:g} s: {what}"
        time.sleep(0.01)
    return time.monotonic() - begun_s
