"""Who is calling, and the code with which a page in a browser comes to be somebody."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response

from service.http.problems import Problem
from service.server.api.access.client_address import address_of, is_this_computer
from service.server.api.access.scopes import Principal, require
from service.server.api.openapi import answers, example
from service.server.api.services import services_of
from service.server.database.pairing import NoCodeError, TooManyTriesError, WrongCodeError
from service.server.schemas.control import PairingBody, PairingView, WhoamiView
from service.server.schemas.examples import PAIRING_EXAMPLE, WHOAMI_EXAMPLE

router = APIRouter(tags=["operations"])

Known = Annotated[Principal, Depends(require())]


@router.get(
    "/v1/whoami",
    summary="Who is calling",
    responses=answers({200: example(WHOAMI_EXAMPLE)}),
)
async def whoami(response: Response, principal: Known) -> WhoamiView:
    """Name and scopes of the caller; 401 for one who is nobody here and needs a token or a code."""
    response.headers["Cache-Control"] = "no-store"
    return WhoamiView.model_validate(principal)


@router.post(
    "/v1/pairings",
    summary="Pair a page",
    status_code=201,
    responses=answers({201: example(PAIRING_EXAMPLE)}),
)
async def pair(request: Request, response: Response, body: PairingBody) -> PairingView:
    """A token for who knows the code that the server has printed where it runs: jobs, and running mills, for a day.

    Five wrong tries may come at once from an address, then one a minute; 429 says when to try again.
    """
    response.headers["Cache-Control"] = "no-store"
    return await asyncio.to_thread(_pair, request, body)


def _pair(request: Request, body: PairingBody) -> PairingView:
    """Pair in a thread: digests are slow, and a terminal may be, too."""
    services = services_of(request)
    address = address_of(request.scope, behind_proxy=services.settings.behind_proxy)
    # Whoever is at this computer is not slowed down by a crowd elsewhere.
    counts_for_all = not is_this_computer(address)
    try:
        token, secret = services.pairings.pair(body.code, body.name, address=address, counts_for_all=counts_for_all)
    except WrongCodeError as error:
        again = ". The code has just been printed again where the server runs" if services.terminal.show() else ""
        raise Problem(403, f"{error}{again}", field="code", more={"left": error.left}) from None
    except NoCodeError as error:
        words = "this code has ended; a new one has just been printed where the server runs"
        raise Problem(403, words if services.terminal.show() else str(error), field="code") from None
    except TooManyTriesError as error:
        raise Problem(429, str(error), field="code", headers={"Retry-After": str(error.wait_s)}) from None
    return PairingView.model_validate(asdict(token) | {"token": secret}, extra="ignore")
