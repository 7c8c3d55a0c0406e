"""Mills: list them, watch them, hand a program to one, where it waits for a person; and control of a mill outside its
runs: who has it, and what they order. Anybody may stop a mill.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Request, Response
from starlette.responses import StreamingResponse

from machines.mill.orders import Stop
from service.http.event_hub import EVENT_HEADERS
from service.http.schema import Json, PassedOn
from service.milling.api import ORDERS, ControlBody, GrantBody, GrantView, PastOrders
from service.server.api.access.guard import Operator, Order, Reader, Stopper
from service.server.api.errors import Responses, event_stream, refusals
from service.server.api.intake.request import idempotency_key
from service.server.api.services import services_of
from service.server.schemas.runs import PLAIN, ControlView, MachineList, MachineView, NewRunBody, OrderView, RunView

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
    """Every mill that has an agent or should have one, including those that do not answer or have a broken profile."""
    return await services_of(request).fleet.list_machines()


@router.get("/v1/machines/{machine}", summary="Look at a mill")
async def look(request: Request, _: Reader, machine: MachineName) -> MachineView:
    return await services_of(request).fleet.get_machine(machine)


@router.get(
    "/v1/machines/{machine}/camera.jpg",
    summary="Look through its camera",
    response_class=Response,
    responses={200: {"description": "what it sees now", "content": {"image/jpeg": {}}}, **refusals(502, 504)},
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
    """Orders and stops, newest first: time, person, origin and outcome. The mill's agent keeps them."""
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
    """The program goes to the mill's agent, which reads all of it and checks it against the mill. Nothing moves.

    One run has a mill at a time: while another is open this is refused.
    """
    key = idempotency_key(idempotency_key_header, principal)
    fleet = services_of(request).fleet
    run, parked = await fleet.park(
        machine, str(body.job), body.program, principal.name, key, context, lift_mm=body.lift_mm
    )
    response.headers["Location"] = run.links["self"]
    if not parked:
        response.status_code = 202
        response.headers["Retry-After"] = "1"
    return run


_GIVEN: Responses = {
    201: {"description": "control is yours"},
    200: {"description": "it was yours, and stays so", "model": ControlView},
}
_TOLD: Responses = {202: {"description": "the mill's agent has taken the order"}}
_ORDER: dict[str, Any] = {"status_code": 202, "responses": _TOLD | refusals(409, 428, 502, 504, 507)}
_STOP: dict[str, Any] = {"status_code": 202, "responses": _TOLD | refusals(409, 502, 504, 507)}
_EVENTS = (
    'id: 5c1d-87\nevent: status\ndata: {"name":"shop-mill","mill":{"state":"jog"},"run":null,"control":null}\n\n'
    'id: 5c1d-88\nevent: log\ndata: {"number":88,"at_s":1763712000.1,"kind":"state","words":"jog -> idle"}\n\n'
)
_CONTROL = "/v1/machines/{machine}/control"
_WITH_BODY = {
    "jog": (
        "Jog a mill",
        "THE MILL MOVES by that distance. Send it once, like every order; the events report its result.",
    ),
    "go-to-zero": (
        "Go to the work zero",
        "THE MILL MOVES up to a safe height and across to X0 Y0; with XYZ then down to Z0. Refused where the position\n"
        "is not certain, a zero is not set, or a place on the way lies outside the travel.",
    ),
    "frame": (
        "Go around the outline of the program that waits",
        "THE MILL MOVES up, at least to the height at which the program travels, and around its outline there.\n"
        "Refused as go-to-zero is.",
    ),
    "probe": ("Probe Z", "THE MILL MOVES down until it touches; work Z is set there, and it moves up again."),
    "probe-corner": (
        "Probe a block's corner",
        "THE MILL MOVES down, aside, down and back, to the left and to the front of where it stands. Where a touch is\n"
        "missing, or anything stops it, no zero is changed.",
    ),
    "zero": ("Set the work zero", "From now on the tool stands at zero of these axes."),
    "override": ("Override feed, rapids or spindle", "At once, in the middle of a run too."),
    "spindle": (
        "Switch the spindle by hand",
        "THE SPINDLE TURNS. Only while the mill is idle and no program is under way, within the mill's speeds. It\n"
        "goes off when control is given back, taken over or lost, and with a hold or an abort. Until it is off no\n"
        "program starts and nothing is probed.",
    ),
    "check": ("Switch check mode", "In check mode ($C) the controller reads everything and moves nothing."),
    "block": ("Send one line of G-code", "THE MILL MAY MOVE."),
}
_PLAIN = {
    "home": "THE MILL MOVES to its switches.",
    "unlock": "Clear an alarm. The position may be wrong afterwards: look before you move.",
    "reset": "Soft reset of a controller that stands.",
    "resume": "THE MILL MOVES on from where it was held.",
    "trust-position": "A person says that the position is right.",
    "settings": "Read the controller's settings again.",
}
_STOPS = {
    Stop.HOLD: "Feed hold: the mill stops and keeps its place. No emergency stop: that one is on the machine.",
    Stop.ABORT: "Hold, and clear what the controller has left.",
    Stop.JOG_CANCEL: "End a jog; the place is kept.",
}
Endpoint = Callable[..., Awaitable[OrderView]]


@router.post(
    "/v1/machines/{machine}/control",
    summary="Take or keep control of a mill",
    status_code=201,
    responses=_GIVEN | refusals(409),
)
async def take(
    request: Request, response: Response, _: Operator, machine: MachineName, body: ControlBody, context: Order
) -> ControlView:
    """One person has control at a time. Any order keeps it, and so does asking again with the header, at least once a
    minute.
    """
    orders = services_of(request).fleet.orders
    control, new = await orders.take(machine, context, body.operator, take_over=body.take_over)
    response.status_code = 201 if new else 200
    response.headers["Cache-Control"] = "no-store"
    return control


@router.delete(
    "/v1/machines/{machine}/control",
    summary="Give control of a mill back",
    status_code=204,
    response_class=Response,
    responses=refusals(409),
)
async def release(request: Request, _: Operator, machine: MachineName, context: Order) -> Response:
    await services_of(request).fleet.orders.release(machine, context)
    return Response(status_code=204)


@router.post(
    "/v1/machines/{machine}/grants",
    summary="Ask for a grant",
    status_code=201,
    responses=refusals(409, 502, 504),
)
async def grant(
    request: Request,
    response: Response,
    _: Operator,
    machine: MachineName,
    context: Order,
    body: GrantBody | None = None,
) -> GrantView:
    """Ask for a grant when the person presses the button, and send it with the order. With it the mill's agent carries
    out one order, within seconds, unless somebody stops the mill or takes control first. Do not use a grant that took
    longer than two seconds to come: ask again.
    """
    response.headers["Cache-Control"] = "no-store"
    return await services_of(request).fleet.orders.grant(machine, context, None if body is None else body.stops)


@router.get(
    "/v1/machines/{machine}/events",
    summary="Follow a mill",
    response_class=Response,
    responses=event_stream("the stream; it has no end", _EVENTS),
)
async def events(
    request: Request,
    _: Reader,
    machine: MachineName,
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", max_length=100)] = None,
) -> Response:
    """`status`: the state of the mill, as GET of the machine gives it, at once and at most five times a second; `log`:
    what happens at the mill. The stream goes on while the mill's agent is away. A reader that returns with the id of
    its last event misses nothing that the agent remembers; a new reader gets the latest part of it.
    """
    stream = await services_of(request).fleet.follow_machine(machine, last_event_id or "")
    return StreamingResponse(stream, headers=EVENT_HEADERS)


def _make_order(what: str) -> Endpoint:
    async def order(request: Request, _: Operator, machine: MachineName, context: Order) -> OrderView:
        return await services_of(request).fleet.orders.give(machine, what, {}, context)

    return order


def _make_order_with_body(what: str) -> Endpoint:
    async def order(request: Request, _: Operator, machine: MachineName, body: Json, context: Order) -> OrderView:
        return await services_of(request).fleet.orders.give(machine, what, body, context)

    order.__annotations__["body"] = Annotated[Json, PassedOn(ORDERS[what])]
    return order


def _make_stop(stop: Stop) -> Endpoint:
    async def order(request: Request, _: Stopper, machine: MachineName, context: Order) -> OrderView:
        return await services_of(request).fleet.stops.stop_machine(machine, stop, context)

    return order


for _what, (_summary, _words) in _WITH_BODY.items():
    router.post(f"{_CONTROL}/{_what}", name=_what.replace("-", "_"), summary=_summary, description=_words, **_ORDER)(
        _make_order_with_body(_what)
    )
for _what, _words in _PLAIN.items():
    router.post(f"{_CONTROL}/{_what}", summary=f"Order: {_what}", description=_words, **_ORDER)(_make_order(_what))
for _name in Stop:
    router.post(f"{_CONTROL}/{_name}", summary=f"Stop: {_name}", description=_STOPS[_name], **_STOP)(_make_stop(_name))
