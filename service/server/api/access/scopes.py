"""Who calls, and what they may do. The guard finds out who; a route says which scopes it needs: `require(...)`.

A route without `require` is not open: the guard lets nobody but a known caller pass, except to what OPEN names.
No scope contains another: `admin` alone moves no mill.

What an order comes with is read here, too: whose it is, from where, since when, and under which control and grant.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Header, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.requests import HTTPConnection
from starlette.types import Scope

from machines.clock import suspend_aware_clock_s
from phrases.phrase import Phrase
from service.errors import InputError
from service.http.hosts import is_loopback, require_unread
from service.http.problems import CONTROL, GRANT, Problem
from service.server.api.access.headers import address_of
from service.server.api.services import services_of
from service.server.database.tokens import TokenBook, TokenScope
from service.server.fleet.agent_client import AT_THE_SERVER, OrderContext
from service.settings import ServerSettings

JOBS_READ, JOBS_WRITE = TokenScope.JOBS_READ, TokenScope.JOBS_WRITE
MACHINE_RUN, ADMIN = TokenScope.MACHINE_RUN, TokenScope.ADMIN

_KEY, _OPEN_KEY = "causticmill.principal", "causticmill.open"
_ARRIVED_KEY, _AT_SERVER_KEY, _STOP_KEY = "causticmill.arrived_s", "causticmill.at_server", "causticmill.stop"
_bearer = HTTPBearer(auto_error=False, bearerFormat="cm_...", description="A token of `causticmill token create`.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Principal:
    """A caller: name of the token, its scopes and its id. Nobody else has the name as long as the token lives."""

    name: str
    scopes: frozenset[str]
    anonymous: bool = False
    id: str = ""
    paired: bool = False
    expires_at: float | None = None


_NEEDED = Phrase("a token is needed: Authorization: Bearer cm_...")
ANONYMOUS = Principal(name="anonymous", scopes=frozenset({JOBS_READ, JOBS_WRITE}), anonymous=True, id="anonymous")


def require(*scopes: TokenScope) -> Callable[..., Awaitable[Principal]]:
    """Return a dependency that gives the Principal, if it has every one of the scopes; 401 or 403 otherwise."""
    needed = frozenset(map(str, scopes))

    async def dependency(
        request: Request, _shown: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]
    ) -> Principal:
        principal = principal_of(request.scope)
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


def require_stop() -> Callable[..., Awaitable[None]]:
    """Return a dependency for what stops a mill: the guard has decided who may
    (service/server/api/access/stop_access.py).
    """

    async def dependency(
        request: Request, _shown: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]
    ) -> None:
        if not request.scope.get(_STOP_KEY):
            await require(MACHINE_RUN)(request, None)

    dependency.required_scopes = frozenset({str(MACHINE_RUN)})  # type: ignore[attr-defined]
    return dependency


Stopper = Annotated[None, Depends(require_stop())]
Reader = Annotated[Principal, Depends(require(JOBS_READ))]
Writer = Annotated[Principal, Depends(require(JOBS_WRITE))]
Operator = Annotated[Principal, Depends(require(MACHINE_RUN))]
Admin = Annotated[Principal, Depends(require(ADMIN))]


def principal_of(scope: Scope) -> Principal | None:
    """Return whom the guard has found to be calling."""
    found = scope.get(_KEY)
    return found if isinstance(found, Principal) else None


def note_principal(scope: Scope, principal: Principal) -> None:
    scope[_KEY] = principal


def is_open_here(request: Request) -> bool:
    """Return whether the guard let this request in anonymously: it came from this computer, to an open address."""
    return bool(request.scope.get(_OPEN_KEY))


def note_open(scope: Scope) -> None:
    scope[_OPEN_KEY] = True


def note_stopper(scope: Scope) -> None:
    scope[_STOP_KEY] = True


def note_arrival(scope: Scope, *, at_server: bool) -> None:
    """Note when the request came, by a clock that runs in suspend, and whether from this very computer."""
    scope[_ARRIVED_KEY], scope[_AT_SERVER_KEY] = suspend_aware_clock_s(), at_server


def arrival_s(scope: Scope) -> float:
    return float(scope[_ARRIVED_KEY])


def is_at_server(scope: Scope) -> bool:
    return bool(scope.get(_AT_SERVER_KEY))


def not_authorised(words: Phrase = _NEEDED) -> Problem:
    return Problem(401, words, field="Authorization")


def refuse_foreign_bind(settings: ServerSettings, tokens: TokenBook) -> None:
    """Raise InputError where the server would be reachable from elsewhere without tokens, or without TLS before it."""
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
    return context_of(request, control=control, grant=grant)


def context_of(connection: HTTPConnection, *, control: str = "", grant: str = "", name: str = "") -> OrderContext:
    principal = principal_of(connection.scope)
    behind_proxy = services_of(connection).settings.behind_proxy
    return OrderContext(
        name=name or (principal.name if principal is not None else AT_THE_SERVER),
        origin=address_of(connection.scope, behind_proxy=behind_proxy),
        control=control,
        grant=grant,
        arrived_s=arrival_s(connection.scope),
    )


Order = Annotated[OrderContext, Depends(read_order_context)]
