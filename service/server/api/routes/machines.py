"""Machines: which there are, what they do, and a program handed to one of them, where it waits for a person."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Path, Query, Request, Response

from service.milling.api import PastOrders
from service.server.api.access.scopes import Operator, Order, Reader
from service.server.api.intake.request import idempotency_key
from service.server.api.openapi import Responses, refusals
from service.server.api.services import services_of
from service.server.schemas.runs import PLAIN, MachineList, MachineView, NewRunBody, RunView

router = APIRouter(tags=["machines"])

_PARKED: Responses = {
    201: {"description": "parked: it waits for :start"},
    202: {"description": "still being handed over, ask again: a large program takes its time", "model": RunView},
}
MachineName = Annotated[
    str, Path(max_length=100, pattern=PLAIN, description="name of a machine", examples=["shop-mill"])
]


@router.get("/v1/machines", summary="List the mills")
async def list_machines(request: Request, _: Reader) -> MachineList:
    """Every mill that has an agent or should have one; one that does not answer, or whose profile is broken, too."""
    return await services_of(request).fleet.list_machines()


@router.get("/v1/machines/{machine}", summary="Look at a mill")
async def look(request: Request, _: Reader, machine: MachineName) -> MachineView:
    return await services_of(request).fleet.get_machine(machine)


@router.get(
    "/v1/machines/{machine}/camera.jpg",
    summary="Look through its camera",
    response_class=Response,
    responses={200: {"description": "what it sees now", "content": {"image/jpeg": {}}}} | refusals(502, 504),
)
async def look_through_camera(request: Request, _: Reader, machine: MachineName) -> Response:
    """A picture of the camera beside the mill, where the server's settings name one (`links.camera`)."""
    picture = await services_of(request).fleet.take_picture(machine)
    headers = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
    return Response(picture, media_type="image/jpeg", headers=headers)


@router.get(
    "/v1/machines/{machine}/orders",
    summary="Who ordered what",
    response_model_exclude_unset=True,
    responses=refusals(502, 504),
)
async def list_orders(
    request: Request,
    _: Reader,
    machine: MachineName,
    before: Annotated[int | None, Query(ge=0, le=1 << 53, description="`next` of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
) -> PastOrders:
    """Orders and stops, newest first: when, whose, from where, and what came of them. Kept by the mill's agent."""
    return await services_of(request).fleet.list_past_orders(machine, before, limit)


@router.post(
    "/v1/machines/{machine}/runs",
    summary="Hand a program to a mill",
    status_code=201,
    responses=_PARKED | refusals(409, 502, 504, 507),
)
async def park(
    request: Request,
    response: Response,
    principal: Operator,
    machine: MachineName,
    body: NewRunBody,
    context: Order,
    idempotency_key_header: Annotated[
        str | None,
        Header(alias="Idempotency-Key", description="the same key with the same request gives the same run"),
    ] = None,
) -> RunView:
    """The program goes to the mill's agent, which reads it whole and holds it against the mill. Nothing moves.

    One run has a mill at a time: while another is open this is refused.
    """
    key = idempotency_key(idempotency_key_header, principal)
    fleet = services_of(request).fleet
    run, parked = await fleet.park(machine, str(body.job), body.program, principal.name, key, context)
    response.headers["Location"] = run.links["self"]
    if not parked:
        response.status_code = 202
        response.headers["Retry-After"] = "1"
    return run
