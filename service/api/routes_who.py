"""Who is calling, and the code with which a page in a browser comes to be somebody."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from starlette.responses import JSONResponse, Response

from service.api.answers import answers, example
from service.api.auth import Principal, require
from service.api.examples_runs import PAIRING_EXAMPLE, WHOAMI_EXAMPLE
from service.api.schemas_control import PairingBody, PairingView, WhoamiView
from service.api.services import services_of
from service.api.times import iso_or_none
from service.jobs.pairing import WrongCodeError
from service.web.problems import Problem

router = APIRouter(tags=["operations"])

Known = Annotated[Principal, Depends(require())]


@router.get(
    "/v1/whoami",
    summary="Who is calling",
    response_model=WhoamiView,
    responses=answers({200: example(WHOAMI_EXAMPLE)}),
)
async def whoami(principal: Known) -> Response:
    """Name and scopes of the caller; 401 for one who is nobody here and needs a token or a code."""
    told = {"name": principal.name, "scopes": sorted(principal.scopes), "anonymous": principal.anonymous}
    return JSONResponse(told | {"paired": principal.paired}, headers={"Cache-Control": "no-store"})


@router.post(
    "/v1/pairings",
    summary="Pair a page",
    status_code=201,
    response_model=PairingView,
    responses=answers({201: example(PAIRING_EXAMPLE)}),
)
async def pair(request: Request, body: PairingBody) -> Response:
    """A token for who knows the code that the server has printed where it runs: jobs, and running mills, for a day.

    After five wrong tries only a new code helps, which `causticmill token pair` makes on the server's computer.
    """
    try:
        token, secret = await asyncio.to_thread(services_of(request).pairings.pair, body.code, body.name)
    except WrongCodeError as error:
        raise Problem(403, str(error), field="code", more={"left": error.left}) from None
    told = {"token": secret, "name": token.name, "scopes": sorted(token.scopes)}
    return JSONResponse(
        told | {"expires_at": iso_or_none(token.expires_at)}, status_code=201, headers={"Cache-Control": "no-store"}
    )
