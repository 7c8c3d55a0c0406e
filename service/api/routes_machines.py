"""Machines: which there are, what they do, and a program handed to one of them, where it waits for a person."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Path, Request
from starlette.responses import JSONResponse, Response

from service.api.answers import Responses, answers, example, refusals
from service.api.auth import Operator, Reader
from service.api.examples_runs import MACHINE_EXAMPLE, MACHINES_EXAMPLE, PREPARING_EXAMPLE, RUN_EXAMPLE
from service.api.job_request import idempotency_key
from service.api.schemas_runs import PLAIN, MachineList, MachineView, NewRunBody, RunView
from service.api.services import services_of
from service.fleet.orders import HEADER

router = APIRouter(tags=["machines"])

_PARKED: Responses = {
    201: example(RUN_EXAMPLE) | {"description": "parked: it waits for :start"},
    202: example(PREPARING_EXAMPLE)
    | {"description": "still being handed over, ask again: a large program takes its time", "model": RunView},
}
MachineName = Annotated[
    str, Path(max_length=100, pattern=PLAIN, description="name of a machine", examples=["shop-mill"])
]
Shown = Annotated[
    str,
    Header(
        alias=HEADER, max_length=100, pattern=r"^[!-~]*$", description="the `control` of who has control of the mill"
    ),
]


@router.get(
    "/v1/machines",
    summary="List the mills",
    response_model=MachineList,
    responses=answers({200: example(MACHINES_EXAMPLE)}),
)
async def listed(request: Request, _: Reader) -> Response:
    """Every mill that has an agent or should have one; one that does not answer, or whose profile is broken, too."""
    return JSONResponse(await services_of(request).fleet.machines())


@router.get(
    "/v1/machines/{machine}",
    summary="Look at a mill",
    response_model=MachineView,
    responses=answers({200: example(MACHINE_EXAMPLE)}),
)
async def look(request: Request, _: Reader, machine: MachineName) -> Response:
    return JSONResponse(await services_of(request).fleet.machine(machine))


@router.post(
    "/v1/machines/{machine}/runs",
    summary="Hand a program to a mill",
    status_code=201,
    response_model=RunView,
    responses=_PARKED | refusals(409, 502, 504, 507),
)
async def park(
    request: Request,
    principal: Operator,
    machine: MachineName,
    body: NewRunBody,
    idempotency_key_header: Annotated[
        str | None,
        Header(alias="Idempotency-Key", description="the same key with the same request gives the same run"),
    ] = None,
    control: Shown = "",
) -> Response:
    """The program goes to the mill's agent, which reads it whole and holds it against the mill. Nothing moves.

    One run has a mill at a time: while another is open this is refused.
    """
    key = idempotency_key(idempotency_key_header)
    fleet = services_of(request).fleet
    run, parked = await fleet.park(machine, str(body.job), body.program, principal.name, key, control)
    headers = {"Location": f"/v1/runs/{run['id']}"} | ({} if parked else {"Retry-After": "1"})
    return JSONResponse(run, status_code=201 if parked else 202, headers=headers)
