"""Tokens, for administrators. Nobody gives away more than they have: `admin` alone makes no token that moves a mill."""

from __future__ import annotations

import asyncio
import time
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from service.http.problems import Problem
from service.server.api.access.scopes import Admin
from service.server.api.openapi import answers, example
from service.server.api.services import services_of
from service.server.schemas.examples import NEW_TOKEN_EXAMPLE, TOKEN_EXAMPLE, TOKENS_EXAMPLE
from service.server.schemas.runs import NewTokenBody, NewTokenView, TokenList, TokenView

router = APIRouter(tags=["operations"])

TokenId = Annotated[
    str, Path(alias="id", pattern=r"^[0-9a-z]{1,40}$", description="id of a token, not the token itself")
]


@router.get(
    "/v1/tokens",
    summary="List tokens",
    responses=answers({200: example(TOKENS_EXAMPLE)}),
)
async def list_tokens(request: Request, _: Admin) -> TokenList:
    """All that were ever made, oldest first. The tokens themselves are known to nobody."""
    found = await asyncio.to_thread(services_of(request).tokens.list_rows)
    return TokenList(tokens=[TokenView.model_validate(token) for token in found])


@router.post(
    "/v1/tokens",
    summary="Make a token",
    status_code=201,
    responses=answers({201: example(NEW_TOKEN_EXAMPLE)}, 507),
)
async def create(request: Request, response: Response, principal: Admin, body: NewTokenBody) -> NewTokenView:
    """The answer holds the token, this once."""
    if beyond := sorted(set(body.scopes) - principal.scopes):
        words = f"your token lacks {', '.join(beyond)} itself; `causticmill token create` on the server gives it"
        raise Problem(403, words, field="scopes")
    expires_at = None if body.expires_in_s is None else time.time() + body.expires_in_s
    tokens = services_of(request).tokens
    token, secret = await asyncio.to_thread(tokens.create, body.name, body.scopes, expires_at=expires_at)
    response.headers.update({"Location": f"/v1/tokens/{token.id}", "Cache-Control": "no-store"})
    return NewTokenView(**dict(TokenView.model_validate(token)), token=secret)


@router.delete(
    "/v1/tokens/{id}",
    summary="Revoke a token",
    responses=answers({200: example(TOKEN_EXAMPLE)}),
)
async def revoke(request: Request, _: Admin, token_id: TokenId) -> TokenView:
    """It opens nothing any more, at once. It stays in the list."""
    try:
        token = await asyncio.to_thread(services_of(request).tokens.revoke, token_id)
    except LookupError as error:
        raise Problem(404, str(error), field="id") from None
    return TokenView.model_validate(token)
