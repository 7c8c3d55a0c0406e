"""Decides which connections a server keeps, which one it closes if there are too many, and how many requests a caller
may make.

Theory of operation. A caller who has not shown a token is a stranger. Only a few strangers at once may keep the server
waiting for a head, a body or the first message of a WebSocket: the one that has waited longest is closed for the next
one, and none may take longer than a fixed time, however many bytes it sends meanwhile. The head of a request shows
whether it is a stop: from then on its connection is never closed to make room. The connection of a caller with a token
is closed only when there is no stranger left to close.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from starlette.types import Scope

PLACE = "causticmill.place"  # in the `state` of a scope
STOPS = (":hold", ":abort", "/control/hold", "/control/abort", "/control/jog-cancel")
"""Ends of the paths of stops, at the server and at an agent."""
_MOST_CALLERS = 10_000


def is_stop(method: str, path: str) -> bool:
    """Return whether a request stops a mill."""
    return method == "POST" and path.endswith(STOPS)


class Admission:
    """The places of one server. For one event loop.

    most      : connections in all
    strangers : at most this many for strangers whose request is incomplete
    wait_s    : for a stranger's whole request, or first message; and for the next head of anybody's connection
    """

    def __init__(self, *, most: int, strangers: int, wait_s: float = 30.0) -> None:
        self.most = most
        self.strangers = strangers
        self.wait_s = wait_s
        self._places: dict[Place, None] = {}
        self._waiting: dict[Place, None] = {}  # strangers; the longest waiting one first

    @property
    def is_full(self) -> bool:
        """Return whether there are too many connections and none of them may be closed to make room."""
        return len(self._places) > self.most

    @property
    def count(self) -> int:
        return len(self._places)

    def enter(self, transport: asyncio.Transport) -> Place:
        """Give a new connection a place."""
        place = Place(self, transport)
        self._places[place] = None
        place.await_request()
        if len(self._places) > self.most and (other := self._find_other(place)) is not None:
            other.close()
        return place

    def _await(self, place: Place) -> None:
        self._waiting[place] = None
        if len(self._waiting) > self.strangers:
            next(iter(self._waiting)).close()

    def _stop_waiting(self, place: Place) -> None:
        self._waiting.pop(place, None)

    def _leave(self, place: Place) -> None:
        self._waiting.pop(place, None)
        self._places.pop(place, None)

    def _find_other(self, new: Place) -> Place | None:
        """Find a connection to close: a stranger first, then the longest idle one. None if all are active."""
        others = [place for place in self._places if place is not new and not place.is_stop]
        classes = (
            (place for place in self._waiting if place is not new),
            (place for place in others if not place.is_known),
            (place for place in others if place.is_awaited),
        )
        return next(itertools.chain(*classes), None)


class Place:
    """The state of one connection."""

    def __init__(self, admission: Admission, transport: asyncio.Transport) -> None:
        self._admission = admission
        self._transport = transport
        self._timer: asyncio.TimerHandle | None = None
        self.is_known = False  # its caller has shown a token
        self.is_stop = False  # it has an unanswered stop
        self.is_awaited = False  # its caller still has to send something

    def await_request(self) -> None:
        """Start waiting for a request, for a fixed time."""
        self.stop_waiting()
        self.is_stop, self.is_awaited = False, True
        self._timer = asyncio.get_running_loop().call_later(self._admission.wait_s, self.close)
        if not self.is_known:
            self._admission._await(self)

    def stop_waiting(self) -> None:
        """Stop waiting: the request has arrived."""
        if self._timer is not None:
            self._timer.cancel()
        self.is_awaited = False
        self._admission._stop_waiting(self)

    def answer_stop(self) -> None:
        """Keep the connection until its stop is answered."""
        self.stop_waiting()
        self.is_stop = True

    def identify(self) -> None:
        """Note that the caller has shown a token."""
        self.is_known = True
        self.stop_waiting()

    def leave(self) -> None:
        """Give up the place: the connection is lost."""
        self.stop_waiting()
        self._admission._leave(self)

    def close(self) -> None:
        self.leave()
        self._transport.abort()


def note_known(scope: Scope) -> None:
    """Note that the caller has shown a token."""
    place = (scope.get("state") or {}).get(PLACE)
    if isinstance(place, Place):  # an application may be called without a server
        place.identify()


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
