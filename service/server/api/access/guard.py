"""The door: before any route is looked at, every request is held against what a browser or a stranger could make up.

Plain ASGI, so that streams pass through untouched. In this order: what is not HTTP, malformed or foreign headers, who
is calling, how much they ask for. A caller is known by a token; without one, and only as long as no token was ever
made, somebody on this very computer (not somebody whom a proxy on it lets in) may work with jobs, never with mills. How
much one caller may ask for is a bucket of requests for each, which fills up again with time.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Receive, Scope, Send

from phrases.phrase import Phrase
from service.http.admission import is_stop, note_known
from service.http.hosts import own_names
from service.http.problems import Problem, problem_response
from service.server.api.access.headers import (
    Headers,
    address_of,
    is_here,
    read_headers,
    read_secret,
    refuse_foreign_page,
)
from service.server.api.access.scopes import (
    ANONYMOUS,
    MACHINE_RUN,
    Principal,
    is_at_server,
    not_authorised,
    note_arrival,
    note_open,
    note_principal,
    note_stopper,
)
from service.server.api.services import Services
from service.server.database.tokens import PAGE_TOKEN_LIFE_S, Token

OPEN_HERE = frozenset({"/livez", "/readyz", "/metrics"})  # to callers on this computer
OPEN = frozenset({"/", "/openapi.json", "/v1/pairings"})  # to everybody: what a code opens is the code's affair
OPEN_BELOW = "/page/"  # files that hold no data

_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_BURST_S = 10.0
_LOOK_UPS = 4
_WRONG_PER_S, _WRONG_AT_ONCE = 20.0, 200.0  # tokens that we have not seen, from one address

_MOST_CALLERS = 10_000
T = TypeVar("T")


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


def _principal(token: Token) -> Principal:
    return Principal(
        name=token.name, scopes=token.scopes, id=token.id, paired=token.paired, expires_at=token.expires_at
    )


class Guard:
    """ASGI middleware; put it outermost."""

    def __init__(self, app: ASGIApp, *, services: Services) -> None:
        settings = services.settings
        self._app = app
        self._tokens = services.tokens
        self._stop_access = services.stop_access
        self._fleet = services.fleet
        self._behind_proxy = settings.behind_proxy
        self._names = own_names(settings.allowed_hosts)
        self._anonymous_jobs = settings.anonymous == "jobs" and not settings.behind_proxy
        # A proxy that adds no header of its own makes strangers look like callers on this computer.
        self._open_here = OPEN_HERE - ({"/metrics"} if settings.behind_proxy else set())
        self._requests = Limiter(settings.requests_per_s, _BURST_S * settings.requests_per_s)
        self._jobs = Limiter(settings.jobs_per_min / 60, settings.jobs_per_min)
        self._wrong = Limiter(_WRONG_PER_S, _WRONG_AT_ONCE)
        # Threads of its own: a hold never waits for its caller to be recognised behind slow downloads.
        self._threads = ThreadPoolExecutor(_LOOK_UPS, thread_name_prefix="guard")
        self._notes = ThreadPoolExecutor(1, thread_name_prefix="guard-notes")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            try:
                await self._admit(scope)
            except Problem as problem:
                await problem_response(problem)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    async def _admit(self, scope: Scope) -> None:
        headers = read_headers(scope, self._names)
        if scope["method"] not in _SAFE or scope["path"] in OPEN_HERE:
            refuse_foreign_page(scope, headers, behind_proxy=self._behind_proxy)
        here = is_here(scope, headers)
        note_arrival(scope, at_server=here and not self._behind_proxy)
        if is_stop(scope["method"], scope["path"]):
            await self._admit_stop(scope, headers)
            return
        if here and scope["path"] in self._open_here:  # and stays so when the database is away
            note_open(scope)
            self._charge(scope, None, bucket="health")
            return
        if scope["path"] in OPEN or scope["path"].startswith(OPEN_BELOW):
            self._charge(scope, None)
            return
        principal = await self._identify(scope, headers, here)
        if principal is None:
            wrong = b"authorization" in headers
            raise not_authorised(Phrase("this token is unknown, expired or revoked")) if wrong else not_authorised()
        if not principal.anonymous:
            self._charge(scope, principal)

    async def _admit_stop(self, scope: Scope, headers: Headers) -> None:
        """Admit a stop, which is never too much and asks for nothing that could be busy: a token that was seen before
        is known from memory. One that was not is looked up as for any request.
        """
        secret = read_secret(headers)
        if (stopper := self._stop_access.find(secret)) is not None:
            note_known(scope)
            note_principal(scope, Principal(name=stopper.name, scopes=frozenset({MACHINE_RUN}), id=stopper.id))
            note_stopper(scope)
        elif is_at_server(scope):
            note_stopper(scope)
        else:
            principal = await self._identify(scope, headers, is_here(scope, headers))
            if principal is None:
                raise not_authorised()

    async def _identify(self, scope: Scope, headers: Headers, here: bool) -> Principal | None:
        """Identify the caller. Charge a caller without a known token before the database is asked."""
        shown, secret = b"authorization" in headers, read_secret(headers)
        if not self._stop_access.knows(secret):
            self._charge(scope, None, limiter=self._wrong if shown else self._requests)
        try:
            if shown:
                token = await self._look_up(self._tokens.find, secret)
                principal = None if token is None else self._accept_token(token, secret)
            elif here and self._anonymous_jobs and not await self._look_up(self._tokens.has_ever_had_any):
                principal = ANONYMOUS
            else:
                principal = None
        except SQLAlchemyError:
            words = Phrase("the database cannot be asked who you are; try again")
            raise Problem(503, words, headers={"Retry-After": "2"}) from None
        if principal is not None:
            note_principal(scope, principal)
            if not principal.anonymous:
                note_known(scope)
        return principal

    async def _look_up(self, find: Callable[..., T], *arguments: str) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, find, *arguments)

    def _accept_token(self, token: Token, secret: str) -> Principal:
        """Accept a token. Its use is noted by another thread: a busy database must not hold a caller up who only
        reads.
        """
        self._stop_access.remember(secret, token)
        self._notes.submit(self._note_use, token)
        return _principal(token)

    def _note_use(self, token: Token) -> None:
        """Note a use. A page's token does not end while it watches a run: its use renews it."""
        with contextlib.suppress(SQLAlchemyError):
            self._tokens.note_use(token, renew_s=PAGE_TOKEN_LIFE_S if self._fleet.has_live_run else None)

    def _charge(
        self, scope: Scope, principal: Principal | None, *, bucket: str = "peer", limiter: Limiter | None = None
    ) -> None:
        """Raise 429 for one who asks for too much."""
        method, path = scope["method"], scope["path"]
        caller = f"token {principal.id}" if principal else f"{bucket} {self._address(scope)}"
        if wait_s := math.ceil((limiter or self._requests).wait_s(caller)):
            words = Phrase("too many requests; try again in {wait_s} s", wait_s=wait_s)
        elif method == "POST" and path == "/v1/jobs" and (wait_s := math.ceil(self._jobs.wait_s(caller))):
            words = Phrase("too many new jobs; try again in {wait_s} s", wait_s=wait_s)
        if wait_s:
            raise Problem(429, words, headers={"Retry-After": str(wait_s)})

    def _address(self, scope: Scope) -> str:
        return address_of(scope, behind_proxy=self._behind_proxy)
