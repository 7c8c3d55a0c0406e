"""Row-parallel kernels: nogil numba functions on strips of rows in plain threads.

Not numba's own `parallel=True`: its default threading layer aborts the process when two Python threads use it at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

_MOST_THREADS = 8
_WORTH_THREADS = 50_000  # values in the largest array: with fewer, starting threads takes as long as computing


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=thread_count(), thread_name_prefix="optics")


@cache
def thread_count() -> int:
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, _MOST_THREADS)


def run_on_rows(kernel: Callable[..., Any], rows: int, *arguments: Any) -> list[Any]:
    """Run kernel(row_lo, row_hi, *arguments) on strips that together are 0..rows; return their results in order."""
    largest = max((one.size for one in arguments if isinstance(one, np.ndarray)), default=_WORTH_THREADS)
    strips = max(1, min(thread_count(), rows)) if largest >= _WORTH_THREADS else 1
    bounds = [rows * s // strips for s in range(strips + 1)]
    if strips == 1:
        return [kernel(0, rows, *arguments)]
    futures = [_pool().submit(kernel, lo, hi, *arguments) for lo, hi in pairwise(bounds)]
    return [future.result() for future in futures]
