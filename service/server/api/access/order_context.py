"""What an order comes with, out of a request: who, from where, since when, and under which control and grant."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Header, Request
from starlette.requests import HTTPConnection

from service.http.problems import CONTROL, GRANT
from service.server.api.access.client_address import address_of
from service.server.api.access.scopes import arrival_s, principal_of
from service.server.api.services import services_of
from service.server.fleet.order_context import AT_THE_SERVER, OrderContext

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
