"""How much one caller may ask for: a bucket of requests for each, which fills up again with time."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

_MOST_CALLERS = 10_000


@dataclass(slots=True)
class _Bucket:
    left: float
    at_s: float


class Limiter:
    """`rate_per_s` requests of each caller in the long run, `burst` at once. For one thread."""

    def __init__(self, rate_per_s: float, burst: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate_per_s = rate_per_s
        self._burst = max(1.0, burst)
        self._clock = clock
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def wait_s(self, caller: str) -> float:
        """Take one request out of the caller's bucket; 0, or the seconds until there is one to take."""
        now = self._clock()
        bucket = self._buckets.setdefault(caller, _Bucket(self._burst, now))
        self._buckets.move_to_end(caller)
        if len(self._buckets) > _MOST_CALLERS:
            self._buckets.popitem(last=False)
        bucket.left = min(self._burst, bucket.left + (now - bucket.at_s) * self._rate_per_s)
        bucket.at_s = now
        if bucket.left < 1:
            return (1 - bucket.left) / self._rate_per_s
        bucket.left -= 1
        return 0.0
