"""Timing for the benchmarks: best of several runs after one that compiles."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Figure:
    """One measured figure."""

    name: str
    value: float
    unit: str
    note: str = ""


def seconds(work: Callable[[], Any], *, runs: int = 3, warm: bool = True) -> tuple[float, float]:
    """(wall, CPU) seconds of the quickest of `runs` calls."""
    if warm:
        work()
    best = (float("inf"), float("inf"))
    for _ in range(runs):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        best = min(best, (time.perf_counter() - wall, time.process_time() - cpu))
    return best
