"""Routes for people who run the server: health, readiness and metrics; the caller's identity; pairing, which turns a
browser page into a caller by a code; and tokens, for administrators. A caller can only grant scopes that the caller
holds: `admin` alone cannot make a token that moves a mill.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import asdict
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BeforeValidator, Field

from phrases.phrase import Phrase, join
from service.http.problems import Kind, Problem
from service.http.schema import Body, Time
from service.milling.api import Person
from service.server.api.access.guard import ADMIN, Admin, Principal, caller_of, require
from service.server.api.access.requests import address_of, is_this_computer
from service.server.api.errors import Responses, refusals
from service.server.api.services import services_of
from service.server.database.pairing import NoCodeError, TooManyTriesError, WrongCodeError
from service.server.schemas.jobs import Alive, Ready

router = APIRouter(tags=["operations"])


async def _require_here_or_known(request: Request) -> None:
    """Admit callers on this computer, or with any token."""
    if not caller_of(request.scope).open_here:
        await require()(request, None)


async def _require_here_or_admin(request: Request) -> None:
    if not caller_of(request.scope).open_here:
        await require(ADMIN)(request, None)


_KnownHere = Depends(_require_here_or_known)
_AdminHere = Depends(_require_here_or_admin)
_PLAIN: dict[str, Any] = {
    "text/plain": {"schema": {"type": "string"}, "example": 'causticmill_jobs{state="queued"} 0\n'}
}
_METRICS: Responses = {200: {"description": "Prometheus text format", "content": _PLAIN}}


@router.get("/livez", summary="Is the process alive?", dependencies=[_KnownHere])
async def livez() -> Alive:
    """Answers as long as the process does; asks nothing of the database."""
    return Alive(alive=True)


@router.get("/readyz", summary="Can the server do its work?", dependencies=[_KnownHere])
async def readyz(request: Request) -> Ready:
    """Writes to the database and to the artifact store, looks for a live worker and for free disk space."""
    services = services_of(request)
    checks = await services.readiness.checks()
    wrong = {name: words for name, words in checks.items() if words != "ok"}
    if wrong:
        detail = join("; ", (Phrase("{name}: {words}", name=name, words=words) for name, words in wrong.items()))
        more = {"ready": False, "checks": checks}
        raise Problem(
            503, detail, field=next(iter(wrong)), kind=Kind.NOT_READY, headers={"Retry-After": "2"}, more=more
        )
    return Ready(ready=True, checks=checks)


@router.get(
    "/metrics",
    summary="Figures for Prometheus",
    dependencies=[_AdminHere],
    response_class=Response,
    responses=_METRICS,
)
async def metrics(request: Request) -> Response:
    """Jobs, stages and artifacts by the database; requests by this process since its start."""
    services = services_of(request)
    services.metrics.followers.set(services.feed.followers)
    try:
        text = await services.metrics.text()
    except TimeoutError:
        raise Problem(503, Phrase("the figures have not been computed yet"), headers={"Retry-After": "2"}) from None
    return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST})


ScopeWord = Literal["jobs:read", "jobs:write", "machine:run", "admin"]
Scopes = Annotated[list[ScopeWord], BeforeValidator(sorted)]


class WhoamiView(Body):
    name: str
    scopes: Scopes
    anonymous: Annotated[bool, Field(description="without a token, from this computer, where no token was ever made")]
    paired: Annotated[bool, Field(description="with a token that a page got for a code")]
    expires_at: Annotated[Time | None, Field(description="when the token ends; null: never")]


class PairingBody(Body):
    code: Annotated[str, Field(min_length=1, max_length=40, description="as printed", examples=["7K3D-0QXM-91TZ"])]
    name: Person


class PairingView(Body):
    token: Annotated[str, Field(description="shown this once; only its SHA-256 is kept")]
    name: Annotated[str, Field(description="of the token: the name given, or that and a number")]
    scopes: Scopes
    expires_at: Time


class NewTokenBody(Body):
    name: Annotated[str, Field(min_length=1, max_length=80, examples=["shop-floor"])]
    scopes: Annotated[list[ScopeWord], Field(min_length=1, max_length=4, examples=[["jobs:read", "jobs:write"]])]
    expires_in_s: Annotated[float | None, Field(gt=0, le=3.1e9, description="null: never", examples=[2592000])] = None


class TokenView(Body):
    id: str
    name: str
    scopes: Scopes
    created_at: Time
    expires_at: Time | None
    last_used_at: Time | None
    revoked_at: Time | None
    paired: Annotated[bool, Field(description="made by a page, for a code")]


class NewTokenView(TokenView):
    token: Annotated[str, Field(description="shown this once; only its SHA-256 is kept")]


class TokenList(Body):
    tokens: list[TokenView]


Known = Annotated[Principal, Depends(require())]
TokenId = Annotated[
    str, Path(alias="id", pattern=r"^[0-9a-z]{1,40}$", description="id of a token, not the token itself")
]


@router.get("/v1/whoami", summary="Who is calling")
async def whoami(response: Response, principal: Known) -> WhoamiView:
    """Name and scopes of the caller; 401 for a stranger, who needs a token or a code."""
    response.headers["Cache-Control"] = "no-store"
    return WhoamiView.model_validate(principal)


@router.post("/v1/pairings", summary="Pair a page", status_code=201)
async def pair(request: Request, response: Response, body: PairingBody) -> PairingView:
    """A token for jobs and for running mills, valid for a day, in return for the code on the server's terminal.

    An address may make five wrong tries at once, then one a minute; 429 says when to try again.
    """
    response.headers["Cache-Control"] = "no-store"
    return await asyncio.to_thread(_pair, request, body)


def _pair(request: Request, body: PairingBody) -> PairingView:
    """Pair in a thread: digests are slow, and a terminal may be, too."""
    services = services_of(request)
    address = address_of(request.scope, behind_proxy=services.settings.behind_proxy)
    # Callers on this computer are not slowed down by a crowd elsewhere.
    counts_for_all = not is_this_computer(address)
    try:
        token, secret = services.pairings.pair(body.code, body.name, address=address, counts_for_all=counts_for_all)
    except WrongCodeError as error:
        words = str(error)
        if services.terminal.show():
            words = Phrase("{refusal}. The code has just been printed again where the server runs", refusal=words)
        raise Problem(403, words, field="code", more={"left": error.left}) from None
    except NoCodeError as error:
        words = Phrase("this code has ended; a new one has just been printed where the server runs")
        raise Problem(403, words if services.terminal.show() else str(error), field="code") from None
    except TooManyTriesError as error:
        raise Problem(429, str(error), field="code", headers={"Retry-After": str(error.wait_s)}) from None
    return PairingView.model_validate(asdict(token) | {"token": secret}, extra="ignore")


@router.get("/v1/tokens", summary="List tokens")
async def list_tokens(request: Request, _: Admin) -> TokenList:
    """All tokens that were ever made, oldest first, without the secrets: the server keeps only digests."""
    found = await asyncio.to_thread(services_of(request).tokens.list_rows)
    return TokenList(tokens=[TokenView.model_validate(token) for token in found])


@router.post("/v1/tokens", summary="Make a token", status_code=201, responses=refusals(507))
async def create(request: Request, response: Response, principal: Admin, body: NewTokenBody) -> NewTokenView:
    """Make a token. Only this answer contains the token itself."""
    if beyond := sorted(set(body.scopes) - principal.scopes):
        words = Phrase(
            "your token lacks {scopes} itself; `causticmill token create` on the server gives it",
            scopes=", ".join(beyond),
        )
        raise Problem(403, words, field="scopes")
    expires_at = None if body.expires_in_s is None else time.time() + body.expires_in_s
    tokens = services_of(request).tokens
    token, secret = await asyncio.to_thread(tokens.create, body.name, body.scopes, expires_at=expires_at)
    response.headers.update({"Location": f"/v1/tokens/{token.id}", "Cache-Control": "no-store"})
    return NewTokenView(**dict(TokenView.model_validate(token)), token=secret)


@router.delete("/v1/tokens/{id}", summary="Revoke a token")
async def revoke(request: Request, _: Admin, token_id: TokenId) -> TokenView:
    """Revoke a token: the server refuses it from now on. It stays in the list."""
    try:
        token = await asyncio.to_thread(services_of(request).tokens.revoke, token_id)
    except LookupError as error:
        raise Problem(404, str(error), field="id") from None
    return TokenView.model_validate(token)
