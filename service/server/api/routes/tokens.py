"""Tokens, for administrators. Nobody gives away more than they have: `admin` alone makes no token that moves a mill."""

from __future__ import annotations

import asyncio
import time
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
from starlette.responses import JSONResponse, Response

from service.http.problems import Problem
from service.server.api.access.scopes import Admin
from service.server.api.answers.times import iso_or_none
from service.server.api.openapi import answers, example
from service.server.api.schemas.examples import NEW_TOKEN_EXAMPLE, TOKEN_EXAMPLE, TOKENS_EXAMPLE
from service.server.api.schemas.runs import NewTokenBody, NewTokenView, TokenList, TokenView
from service.server.api.services import services_of
from service.server.database.tokens import Token

router = APIRouter(tags=["operations"])

TokenId = Annotated[
    str, Path(alias="id", pattern=r"^[0-9a-z]{1,40}$", description="id of a token, not the token itself")
]


@router.get(
    "/v1/tokens",
    summary="List tokens",
    response_model=TokenList,
    responses=answers({200: example(TOKENS_EXAMPLE)}),
)
async def list_tokens(request: Request, _: Admin) -> Response:
    """All that were ever made, oldest first. The tokens themselves are known to nobody."""
    found = await asyncio.to_thread(services_of(request).tokens.list_rows)
    return JSONResponse({"tokens": [_view(token) for token in found]})


@router.post(
    "/v1/tokens",
    summary="Make a token",
    status_code=201,
    response_model=NewTokenView,
    responses=answers({201: example(NEW_TOKEN_EXAMPLE)}, 507),
)
async def create(request: Request, principal: Admin, body: NewTokenBody) -> Response:
    """The answer holds the token, this once."""
    if beyond := sorted(set(body.scopes) - principal.scopes):
        words = f"your token lacks {', '.join(beyond)} itself; `causticmill token create` on the server gives it"
        raise Problem(403, words, field="scopes")
    expires_at = None if body.expires_in_s is None else time.time() + body.expires_in_s
    tokens = services_of(request).tokens
    token, secret = await asyncio.to_thread(tokens.create, body.name, body.scopes, expires_at=expires_at)
    headers = {"Location": f"/v1/tokens/{token.id}", "Cache-Control": "no-store"}
    return JSONResponse(_view(token) | {"token": secret}, status_code=201, headers=headers)


@router.delete(
    "/v1/tokens/{id}",
    summary="Revoke a token",
    response_model=TokenView,
    responses=answers({200: example(TOKEN_EXAMPLE)}),
)
async def revoke(request: Request, _: Admin, token_id: TokenId) -> Response:
    """It opens nothing any more, at once. It stays in the list."""
    try:
        token = await asyncio.to_thread(services_of(request).tokens.revoke, token_id)
    except LookupError as error:
        raise Problem(404, str(error), field="id") from None
    return JSONResponse(_view(token))


def _view(token: Token) -> dict[str, Any]:
    times = ("created_at", "expires_at", "last_used_at", "revoked_at")
    return {"id": token.id, "name": token.name, "scopes": sorted(token.scopes), "paired": token.paired} | {
        name: iso_or_none(getattr(token, name)) for name in times
    }
