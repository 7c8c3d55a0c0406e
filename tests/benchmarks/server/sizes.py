"""How often each figure is measured. BENCH_SHARE=0.2 makes all of it that much shorter."""

from __future__ import annotations

import os

SHARE = float(os.environ.get("BENCH_SHARE", "1"))


def times(full: int) -> int:
    return max(1, round(full * SHARE))


STARTS = times(5)
RESTARTS = times(5)
SUBMITS = times(300)
CANCELS = times(50)
JOBS = times(3)
TAKEOVERS = times(3)
FOLLOWERS = 50
IDLE_S = 30.0 * SHARE
BIG_BYTES = max(50_000_000, int(1_000_000_000 * SHARE))
