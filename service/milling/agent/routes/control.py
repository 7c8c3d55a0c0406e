"""/v1/control: what an operator can ask of the mill beside a run. Stops are taken at any time."""

from __future__ import annotations

from collections.abc import Callable

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.driver import (
    BESIDE_MM,
    CORNER_PLATE_MM,
    CUTTER_RADIUS_MM,
    JOG_FEED,
    JOG_MM,
    MARGIN_MM,
    OVERRIDE_PERCENT,
    PLATE_MM,
    PROBE_DEPTH_MM,
    PROBE_FEED,
    RETRACT_MM,
    ZERO_AXES,
    CheckMode,
    Command,
    Home,
    Jog,
    Override,
    ProbeCorner,
    ProbeZ,
    ReadSettings,
    Reset,
    SendBlock,
    SetZero,
    TrustPosition,
    Unlock,
)
from machines.mill.commands import describe_effect
from machines.mill.mill import Mill
from machines.mill.orders import Stop
from phrases.phrase import Phrase
from service.http.problems import Problem, ServerCode
from service.milling.agent.agent import Agent
from service.milling.agent.callers import read_caller
from service.milling.agent.request_fields import Fields, read_fields

_RANGES = {"feed": OVERRIDE_PERCENT, "rapid": (25, 100), "spindle": OVERRIDE_PERCENT}
_STOPS = frozenset(Stop)


class ControlRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent

    def routes(self) -> list[Route]:
        return [Route("/v1/control/{what}", self.order, methods=["POST"])]

    async def order(self, request: Request) -> Response:
        what = request.path_params["what"]
        access, caller = self._agent.access, read_caller(request)
        if what in _STOPS:  # before the body is looked at: nothing in it could matter
            await access.halt(Stop(what), caller)
            return self._accept()
        if what not in _COMMANDS and what != "resume":
            allowed = ", ".join(sorted([*_STOPS, *_COMMANDS, "resume"]))
            raise Problem(404, f"no control '{what}'; allowed: {allowed}")
        fields = await read_fields(request)
        if what == "resume":
            fields.refuse_unknown()
            await access.order("resume", Mill.resume, caller, needs_lease=True)
            return self._accept()
        command = _COMMANDS[what](fields)
        fields.refuse_unknown()
        await access.order(what, lambda mill: mill.command(command), caller, needs_lease=True)
        return self._accept()

    def _accept(self) -> Response:
        return JSONResponse(self._agent.access.status(), status_code=202)


def _jog(fields: Fields) -> Command:
    return Jog(
        by_mm=fields.triple("by_mm", JOG_MM[1]), feed_mm_per_min=fields.number("feed_mm_per_min", *JOG_FEED, 500)
    )


def _probe(fields: Fields) -> Command:
    return ProbeZ(
        depth_mm=fields.number("depth_mm", *PROBE_DEPTH_MM),
        feed_mm_per_min=fields.number("feed_mm_per_min", *PROBE_FEED, 50),
        plate_mm=fields.number("plate_mm", *PLATE_MM, 0),
        retract_mm=fields.number("retract_mm", *RETRACT_MM, 2),
    )


def _probe_corner(fields: Fields) -> Command:
    return ProbeCorner(
        depth_mm=fields.number("depth_mm", *PROBE_DEPTH_MM),
        plate_mm=fields.number("plate_mm", *CORNER_PLATE_MM),
        wall_x_mm=fields.number("wall_x_mm", *CORNER_PLATE_MM),
        wall_y_mm=fields.number("wall_y_mm", *CORNER_PLATE_MM),
        cutter_radius_mm=fields.number("cutter_radius_mm", *CUTTER_RADIUS_MM),
        margin_mm=fields.number("margin_mm", *MARGIN_MM),
        feed_mm_per_min=fields.number("feed_mm_per_min", *PROBE_FEED, 100),
        aside_mm=fields.number("aside_mm", *BESIDE_MM, 20),
        below_mm=fields.number("below_mm", *BESIDE_MM, 5),
        retract_mm=fields.number("retract_mm", *BESIDE_MM, 5),
    )


def _override(fields: Fields) -> Command:
    what = fields.text("what", allowed=_RANGES)
    low, high = _RANGES[what]
    percent = fields.number("percent", low, high)
    if percent != int(percent) or (what == "rapid" and percent not in (25, 50, 100)):
        allowed = "25, 50, 100" if what == "rapid" else f"whole percents, {low} to {high}"
        raise Problem(422, f"percent is {percent:g}; allowed: {allowed}", field="percent")
    return Override(what, int(percent))


def _block(fields: Fields) -> Command:
    text = fields.text("text", longest=255)
    if not text.isascii() or not text.isprintable() or any(character in text for character in "?!~"):
        raise Problem(422, Phrase("text must be one line of plain G-code, without ? ! ~"), field="text")
    if not fields.flag("confirm", False) and (effect := describe_effect(text)):
        effect = Phrase("'{text}' {effect}", text=text.strip(), effect=effect)
        words = Phrase('{effect}. To send it anyway, send it again with "confirm": true', effect=effect)
        raise Problem(409, words, field="confirm", code=ServerCode.CONFIRM, more={"effect": effect})
    return SendBlock(text)


_COMMANDS: dict[str, Callable[[Fields], Command]] = {
    "reset": lambda fields: Reset(),
    "unlock": lambda fields: Unlock(),
    "home": lambda fields: Home(),
    "jog": _jog,
    "probe": _probe,
    "probe-corner": _probe_corner,
    "zero": lambda fields: SetZero(fields.text("axes", "XYZ", allowed=ZERO_AXES)),
    "trust-position": lambda fields: TrustPosition(),
    "override": _override,
    "check": lambda fields: CheckMode(fields.flag("on")),
    "block": _block,
    "settings": lambda fields: ReadSettings(),
}
