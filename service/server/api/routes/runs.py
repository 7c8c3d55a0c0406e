"""Runs: a person starts, holds, resumes, aborts and recovers them. Nothing else does."""

from __future__ import annotations

from typing import Annotated, Any
from urllib.parse import urlencode
from uuid import UUID

from fastapi import APIRouter, Header, Path, Query, Request, Response
from starlette.responses import StreamingResponse

from machines.mill.orders import Stop
from service.http.event_hub import EVENT_HEADERS
from service.milling.api import RecoverBody, RecoveryView, StartBody
from service.server.api.access.guard import Operator, Order, Reader, Stopper
from service.server.api.errors import Responses, event_stream, refusals
from service.server.api.services import services_of
from service.server.schemas.runs import PLAIN, RUN_ID, RunList, RunView, TimelapseView

router = APIRouter(tags=["runs"])

RunId = Annotated[UUID, Path(alias="id", description="id of a run", examples=[RUN_ID])]
_TOLD: Responses = {202: {"description": "the mill's agent has taken the order"}}
_ORDER: dict[str, Any] = {"status_code": 202, "responses": _TOLD | refusals(409, 428, 502, 504, 507)}
_STOP: dict[str, Any] = {"status_code": 202, "responses": _TOLD | refusals(409, 502, 504, 507)}
_EVENTS = (
    f'event: run\ndata: {{"id":"{RUN_ID}","state":"running","share":0.21,"executed_line":8654}}\n\n'
    'id: 5c1d-88\nevent: log\ndata: {"number":88,"at_s":1763712000.1,"kind":"state","words":"held"}\n\n'
)
_STREAM: Responses = event_stream("the stream; it ends with the run", _EVENTS) | {
    204: {"description": "the run has ended and the client has heard of it: do not come back"},
}


@router.get("/v1/runs", summary="List runs, newest first")
async def list_runs(
    request: Request,
    _: Reader,
    machine: Annotated[str | None, Query(max_length=100, pattern=PLAIN, description="only on this mill")] = None,
    job: Annotated[UUID | None, Query(description="only of this job")] = None,
    limit: Annotated[int, Query(ge=1, le=100)] = 50,
    cursor: Annotated[UUID | None, Query(description="id of the last run of the page before")] = None,
) -> RunList:
    before, of_job = (None if one is None else str(one) for one in (cursor, job))
    found = await services_of(request).fleet.list_runs(machine=machine, job=of_job, limit=limit, before=before)
    chosen = {"machine": machine, "job": job, "limit": limit, "cursor": found[-1].id if found else None}
    address = "/v1/runs?" + urlencode({key: value for key, value in chosen.items() if value is not None})
    return RunList(runs=found, next=address if len(found) == limit else None)


@router.get("/v1/runs/{id:uuid}", summary="Look at a run")
async def look(request: Request, response: Response, _: Reader, run_id: RunId) -> RunView:
    """The run as its agent has it now; with `unreachable`, as it was last known."""
    response.headers["Cache-Control"] = "no-cache"
    return await services_of(request).fleet.get_run(str(run_id))


@router.get("/v1/runs/{id:uuid}/timelapse", summary="List the pictures kept with a run")
async def list_pictures(request: Request, _: Reader, run_id: RunId) -> TimelapseView:
    """What the camera beside the mill saw while the program ran: 300 pictures at most, evenly over its time. Those of
    the newest ten runs are kept.
    """
    return await services_of(request).fleet.list_pictures(str(run_id))


@router.get(
    "/v1/runs/{id:uuid}/timelapse/{n:int}.jpg",
    summary="Look at a picture kept with a run",
    response_class=Response,
    responses={200: {"description": "the picture", "content": {"image/jpeg": {}}}},
)
async def show_picture(
    request: Request,
    _: Reader,
    run_id: RunId,
    number: Annotated[int, Path(alias="n", ge=0, le=1 << 53, description="as the list of pictures has it")],
) -> Response:
    picture = await services_of(request).fleet.get_picture(str(run_id), number)
    headers = {"Cache-Control": "private, max-age=31536000, immutable", "X-Content-Type-Options": "nosniff"}
    return Response(picture, media_type="image/jpeg", headers=headers)


@router.get("/v1/runs/{id:uuid}/events", summary="Follow a run", response_class=Response, responses=_STREAM)
async def events(
    request: Request,
    _: Reader,
    run_id: RunId,
    last_event_id: Annotated[
        str | None, Header(alias="Last-Event-ID", max_length=100, description="id of the last event the client has")
    ] = None,
) -> Response:
    """`run`: how it stands, at every change, a few times a second; `log`: what happened at the mill.

    The stream goes on while the agent is away (`unreachable` in `run`), and ends with the run.
    """
    stream = await services_of(request).fleet.follow_run(str(run_id), last_event_id or "")
    if stream is None:
        return Response(status_code=204)
    return StreamingResponse(stream, headers=EVENT_HEADERS)


@router.get(
    "/v1/runs/{id:uuid}/recovery",
    summary="How a run would go on",
    response_model_exclude_unset=True,
    responses=refusals(409, 502, 504),
)
async def recovery(request: Request, principal: Operator, run_id: RunId) -> RecoveryView:
    """The plan for an interrupted or aborted run. The controller is asked where it is; nothing moves."""
    return await services_of(request).fleet.controls.plan_recovery(str(run_id), principal.name)


@router.post("/v1/runs/{id:uuid}:start", summary="Start a parked run", **_ORDER)
async def start(request: Request, _: Operator, run_id: RunId, said: StartBody, context: Order) -> RunView:
    """THE MILL MOVES. Needs the operator's name and every one of `required_checks`. Sent once, never repeated."""
    return await services_of(request).fleet.start(str(run_id), said, context)


@router.post("/v1/runs/{id:uuid}:hold", summary="Hold a run", **_STOP)
async def hold(request: Request, _: Stopper, run_id: RunId, context: Order) -> RunView:
    """Feed hold: the mill stops and keeps its place. No emergency stop: that one is on the machine."""
    return await services_of(request).fleet.stop_run(str(run_id), Stop.HOLD, context)


@router.post("/v1/runs/{id:uuid}:resume", summary="Resume a held run", **_ORDER)
async def resume(request: Request, _: Operator, run_id: RunId, context: Order) -> RunView:
    """THE MILL MOVES, from where it was held."""
    return await services_of(request).fleet.resume(str(run_id), context)


@router.post("/v1/runs/{id:uuid}:abort", summary="Abort a run", **_STOP)
async def abort(request: Request, _: Stopper, run_id: RunId, context: Order) -> RunView:
    """Hold, and clear the controller's buffers. A run that has not begun is taken back; the mill is free again."""
    return await services_of(request).fleet.stop_run(str(run_id), Stop.ABORT, context)


@router.post("/v1/runs/{id:uuid}:recover", summary="Go on with an interrupted run", **_ORDER)
async def recover(request: Request, _: Operator, run_id: RunId, said: RecoverBody, context: Order) -> RunView:
    """THE MILL MOVES, as the plan of GET recovery says. Needs every one of `required_checks`, the position too."""
    return await services_of(request).fleet.recover(str(run_id), said, context)
