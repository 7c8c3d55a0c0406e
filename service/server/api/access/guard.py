"""Identifies callers, and decides what they may do.

The guard is plain ASGI, so that streams pass through untouched. Before any route, it checks every request for what a
browser or a stranger could forge, in this order: other protocols than HTTP, malformed or foreign headers, the caller,
the rate of requests. A caller is identified by a token. Without one, and only as long as no token was ever made, a
person on this computer (not one let in by a proxy on it) may work with jobs, never with mills. The rate of each caller
is limited by a bucket of requests, which refills with time.

A route states the scopes that it needs: `require(...)`. A route without it is not open: the guard only admits
identified callers, except to the paths in OPEN. No scope includes another: `admin` alone moves no mill. The context of
an order is also read here: who gave it, from where, when, and under which control and grant.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, TypeVar, cast

from fastapi import Depends, Header, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Receive, Scope, Send

from machines.clock import suspend_aware_clock_s
from phrases.phrase import Phrase
from service.errors import InputError
from service.http.admission import Limiter, is_stop, note_known
from service.http.hosts import is_loopback, own_names, require_unread
from service.http.problems import CONTROL, GRANT, Problem, problem_response
from service.server.api.access.requests import (
    Headers,
    address_of,
    is_here,
    read_headers,
    read_secret,
    refuse_foreign_page,
)
from service.server.api.services import Services, services_of
from service.server.database.tokens import PAGE_TOKEN_LIFE_S, Token, TokenBook, TokenScope
from service.server.fleet.agent_client import AT_THE_SERVER, OrderContext
from service.settings import ServerSettings

JOBS_READ, JOBS_WRITE = TokenScope.JOBS_READ, TokenScope.JOBS_WRITE
MACHINE_RUN, ADMIN = TokenScope.MACHINE_RUN, TokenScope.ADMIN

OPEN_HERE = frozenset({"/livez", "/readyz", "/metrics"})  # to callers on this computer
OPEN = frozenset({"/", "/openapi.json", "/v1/pairings"})  # to everyone: pairing checks its code itself
OPEN_BELOW = "/page/"  # files that hold no data

_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_BURST_S = 10.0
_LOOK_UPS = 4
_WRONG_PER_S, _WRONG_AT_ONCE = 20.0, 200.0  # unknown tokens from one address
_KEY = "causticmill.caller"
_NEEDED = Phrase("a token is needed: Authorization: Bearer cm_...")
_bearer = HTTPBearer(auto_error=False, bearerFormat="cm_...", description="A token of `causticmill token create`.")

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Principal:
    """A caller: name of the token, its scopes and its id. The name is unique as long as the token is live."""

    name: str
    scopes: frozenset[str]
    anonymous: bool = False
    id: str = ""
    paired: bool = False
    expires_at: float | None = None


ANONYMOUS = Principal(name="anonymous", scopes=frozenset({JOBS_READ, JOBS_WRITE}), anonymous=True, id="anonymous")


@dataclass(slots=True, kw_only=True)
class Caller:
    """The guard's findings about the sender of a request.

    arrived_s : when the request came, by `suspend_aware_clock_s`
    at_server : the caller is on this computer
    open_here : admitted without a token, from this computer, to an open path
    may_stop  : may stop mills
    """

    arrived_s: float
    at_server: bool
    principal: Principal | None = None
    open_here: bool = False
    may_stop: bool = False


def caller_of(scope: Scope) -> Caller:
    return cast("Caller", scope[_KEY])


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
        # Its own threads, so that identifying the caller of a hold never waits behind slow downloads.
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
        caller = Caller(arrived_s=suspend_aware_clock_s(), at_server=here and not self._behind_proxy)
        scope[_KEY] = caller
        if is_stop(scope["method"], scope["path"]):
            await self._admit_stop(scope, headers)
            return
        if here and scope["path"] in self._open_here:  # and stays so when the database is away
            caller.open_here = True
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
        """Admit a stop. It is never rate-limited and waits for nothing that could be busy: a known token is found in
        memory. An unknown one is looked up as for any request.
        """
        caller, secret = caller_of(scope), read_secret(headers)
        if (stopper := self._stop_access.find(secret)) is not None:
            note_known(scope)
            caller.principal = Principal(name=stopper.name, scopes=frozenset({MACHINE_RUN}), id=stopper.id)
            caller.may_stop = True
        elif caller.at_server:
            caller.may_stop = True
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
            caller_of(scope).principal = principal
            if not principal.anonymous:
                note_known(scope)
        return principal

    async def _look_up(self, find: Callable[..., T], *arguments: str) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, find, *arguments)

    def _accept_token(self, token: Token, secret: str) -> Principal:
        """Accept a token. Another thread records its use, so that a busy database does not hold up a caller who only
        reads.
        """
        self._stop_access.remember(secret, token)
        self._notes.submit(self._note_use, token)
        return _principal(token)

    def _note_use(self, token: Token) -> None:
        """Record a use. It renews a page's token, which therefore does not expire while the page watches a run."""
        with contextlib.suppress(SQLAlchemyError):
            self._tokens.note_use(token, renew_s=PAGE_TOKEN_LIFE_S if self._fleet.has_live_run else None)

    def _charge(
        self, scope: Scope, principal: Principal | None, *, bucket: str = "peer", limiter: Limiter | None = None
    ) -> None:
        """Raise 429 if the caller makes too many requests."""
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


def require(*scopes: TokenScope) -> Callable[..., Awaitable[Principal]]:
    """Return a dependency that gives the Principal, if it has every one of the scopes; 401 or 403 otherwise."""
    needed = frozenset(map(str, scopes))

    async def dependency(
        request: Request, _shown: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]
    ) -> Principal:
        principal = caller_of(request.scope).principal
        if principal is None:
            raise not_authorised()
        if missing := sorted(needed - principal.scopes):
            if principal.anonymous:
                raise Problem(
                    401, Phrase("this needs a token with {scopes}", scopes=", ".join(missing)), field="Authorization"
                )
            words = Phrase("the token '{name}' lacks {scopes}", name=principal.name, scopes=", ".join(missing))
            raise Problem(403, words, field="Authorization")
        return principal

    dependency.required_scopes = needed  # type: ignore[attr-defined]
    return dependency


async def require_stop(
    request: Request, _shown: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]
) -> None:
    """Admit a caller who may stop mills: the guard has decided who (`stop_access`)."""
    if not caller_of(request.scope).may_stop:
        await require(MACHINE_RUN)(request, None)


require_stop.required_scopes = frozenset({str(MACHINE_RUN)})  # type: ignore[attr-defined]
Stopper = Annotated[None, Depends(require_stop)]
Reader = Annotated[Principal, Depends(require(JOBS_READ))]
Writer = Annotated[Principal, Depends(require(JOBS_WRITE))]
Operator = Annotated[Principal, Depends(require(MACHINE_RUN))]
Admin = Annotated[Principal, Depends(require(ADMIN))]


def not_authorised(words: Phrase = _NEEDED) -> Problem:
    return Problem(401, words, field="Authorization")


def refuse_foreign_bind(settings: ServerSettings, tokens: TokenBook) -> None:
    """Raise InputError if the server would be reachable from elsewhere without tokens, or without TLS before it."""
    if is_loopback(settings.host):
        return
    where = f"--host {settings.host} can be reached from other computers"
    fix = "127.0.0.1, or a proxy with TLS in front and CAUSTICMILL_BEHIND_PROXY=true"
    require_unread(settings.host, where, vouched=settings.behind_proxy, allowed=fix)
    if not tokens.has_live():
        raise InputError(f"{where}; make a token first: causticmill token create NAME --scope jobs:read ...")


_Word = {"max_length": 100, "pattern": r"^[!-~]*$"}

Shown = Annotated[str, Header(alias=CONTROL, description="the `control` of who has control of the mill", **_Word)]
Granted = Annotated[
    str,
    Header(
        alias=GRANT,
        description="from POST /v1/machines/{machine}/grants, asked for when the person presses; an order without it "
        "is refused: 428, `code` is `grant_missing`. Stops need none",
        **_Word,
    ),
]


def read_order_context(request: Request, control: Shown = "", grant: Granted = "") -> OrderContext:
    caller = caller_of(request.scope)
    behind_proxy = services_of(request).settings.behind_proxy
    return OrderContext(
        name=AT_THE_SERVER if caller.principal is None else caller.principal.name,
        origin=address_of(request.scope, behind_proxy=behind_proxy),
        control=control,
        grant=grant,
        arrived_s=caller.arrived_s,
    )


Order = Annotated[OrderContext, Depends(read_order_context)]
