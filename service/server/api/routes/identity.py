"""Who is calling, and the code with which a page in a browser comes to be somebody."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from starlette.responses import JSONResponse, Response

from service.http.problems import Problem
from service.server.api.access.client_address import address_of, is_this_computer
from service.server.api.access.scopes import Principal, require
from service.server.api.answers.times import iso_or_none
from service.server.api.openapi import answers, example
from service.server.api.schemas.control import PairingBody, PairingView, WhoamiView
from service.server.api.schemas.examples import PAIRING_EXAMPLE, WHOAMI_EXAMPLE
from service.server.api.services import services_of
from service.server.database.pairing import NoCodeError, TooManyTriesError, WrongCodeError
from service.server.database.tokens import Token

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
    told |= {"paired": principal.paired, "expires_at": iso_or_none(principal.expires_at)}
    return JSONResponse(told, headers={"Cache-Control": "no-store"})


@router.post(
    "/v1/pairings",
    summary="Pair a page",
    status_code=201,
    response_model=PairingView,
    responses=answers({201: example(PAIRING_EXAMPLE)}),
)
async def pair(request: Request, body: PairingBody) -> Response:
    """A token for who knows the code that the server has printed where it runs: jobs, and running mills, for a day.

    Five wrong tries may come at once from an address, then one a minute; 429 says when to try again.
    """
    token, secret = await asyncio.to_thread(_pair, request, body)
    told = {"token": secret, "name": token.name, "scopes": sorted(token.scopes)}
    return JSONResponse(
        told | {"expires_at": iso_or_none(token.expires_at)}, status_code=201, headers={"Cache-Control": "no-store"}
    )


def _pair(request: Request, body: PairingBody) -> tuple[Token, str]:
    """In a thread: digests are slow, and a terminal may be, too."""
    services = services_of(request)
    address = address_of(request.scope, behind_proxy=services.settings.behind_proxy)
    # Whoever is at this computer is not slowed down by a crowd elsewhere.
    counts_for_all = not is_this_computer(address)
    try:
        return services.pairings.pair(body.code, body.name, address=address, counts_for_all=counts_for_all)
    except WrongCodeError as error:
        again = ". The code has just been printed again where the server runs" if services.terminal.show() else ""
        raise Problem(403, f"{error}{again}", field="code", more={"left": error.left}) from None
    except NoCodeError as error:
        words = "this code has ended; a new one has just been printed where the server runs"
        raise Problem(403, words if services.terminal.show() else str(error), field="code") from None
    except TooManyTriesError as error:
        raise Problem(429, str(error), field="code", headers={"Retry-After": str(error.wait_s)}) from None
