"""Validates the answers of agents, and handles missing answers: JSON of a bounded size, and for a run the members that
every run has.

An agent on another computer may be of another version, broken, or not an agent at all. An invalid answer is refused
here, once, as its own problem (502), and is neither stored nor shown.
"""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Awaitable, Mapping
from typing import Any, TypeVar

import httpx
from pydantic import TypeAdapter, ValidationError

from machines.mill.orders import Stop
from service.http.problems import Problem, ServerCode
from service.http.schema import Body, PhraseView
from service.milling.api import RunReply
from service.server.schemas.runs import Holder, OrderView

MOST_BYTES = 4_000_000
_MOST_LETTERS = 2000
_LATEST_S = 4e9  # year 2096: a later value is not a time
Json = dict[str, Any]
T = TypeVar("T")
Reply = TypeVar("Reply", bound=Body)

_PHRASES = TypeAdapter(dict[str, PhraseView])


class AgentAwayError(Exception):
    """The agent did not answer. `code`, `values`: of ServerCode; `sent`: the request may have arrived nevertheless."""

    def __init__(
        self, words: str, code: str = "", values: Mapping[str, object] | None = None, *, sent: bool = False
    ) -> None:
        super().__init__(words)
        self.words = words
        self.code = code
        self.values = dict(values or {})
        self.sent = sent

    def problem(self, order: str = "") -> Problem:
        """Return 503; 504 if this order or stop may have arrived, so that a person has to look."""
        if not (order and self.sent):
            headers = {"Retry-After": "2"}
            return Problem(503, self.words, field="machine", code=self.code, values=self.values, headers=headers)
        code, advice = ServerCode.ORDER_UNCERTAIN, "it is not sent again"
        if order in set(Stop):
            code, advice = ServerCode.STOP_UNCERTAIN, "use its own stop button"
        words = f"{self.words}; whether the {order} arrived is not known: LOOK AT THE MILL, {advice}"
        return Problem(504, words, field="machine", code=code, values=self.values | {"order": order})


def as_problem(error: AgentAwayError | Problem) -> Problem:
    """Return why an agent did not answer a query of its state."""
    return error.problem() if isinstance(error, AgentAwayError) else error


async def require_answer(asking: Awaitable[T], order: str = "") -> T:
    """Return the agent's answer. Problem as in `AgentAwayError.problem`."""
    try:
        return await asking
    except AgentAwayError as away:
        raise away.problem(order) from None


async def read_whole(answer: httpx.Response, machine: str) -> bytes:
    content = bytearray()
    async for piece in answer.aiter_raw():
        content += piece
        if len(content) > MOST_BYTES:
            raise make_wrong_problem(machine, f"answered with more than {MOST_BYTES // 1_000_000} MB")
    return bytes(content)


async def read_lines(answer: httpx.Response, machine: str) -> AsyncIterator[str]:
    """Yield the lines of an event stream; httpx's own reader would buffer an endless line without limit."""
    rest = b""
    async for piece in answer.aiter_raw():
        *lines, rest = (rest + piece).split(b"\n")
        if len(rest) > MOST_BYTES:
            raise make_wrong_problem(machine, "sends an event without an end")
        for line in lines:
            yield line.rstrip(b"\r").decode("utf-8", "replace")


def json_object(content: bytes, machine: str) -> Json:
    """Return the JSON object of an answer; an empty one for an empty answer. Problem 502 for anything else."""
    try:
        values = json.loads(content) if content else {}
        json.dumps(values, allow_nan=False, ensure_ascii=False).encode()  # numbers and texts that can be passed on
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise make_wrong_problem(machine, "answered with something that is not a JSON object")
    return values


def run_view(values: Json, machine: str) -> Json:
    """Return the agent's whole report on a run; a newer agent may report more. Problem 502 if it is not plausible."""
    _validate(RunReply, values, machine, "says what cannot be of its run")
    return values


def make_wrong_problem(machine: str, what: str) -> Problem:
    return Problem(502, f"the agent of '{machine}' {what}", code=ServerCode.AGENT_WRONG)


def parse_reply(kind: type[Reply], values: Json, machine: str) -> Reply:
    """Return the agent's answer for passing on; members of other versions of the agent are left out. Problem 502."""
    return _validate(kind, values, machine, "says what cannot be")


def _validate(kind: type[Reply], values: Json, machine: str, fault: str) -> Reply:
    try:
        return kind.model_validate(values, extra="ignore")
    except ValidationError as error:
        wrong = dict.fromkeys(str(one["loc"][0]) for one in error.errors())
        raise make_wrong_problem(machine, f"{fault}: {', '.join(wrong)}") from None


def parse_holder(values: Json) -> Holder:
    """Parse the holder of control and since when they have it."""
    since_s = values.get("since_s")
    if not isinstance(since_s, int | float) or not 0 <= since_s < _LATEST_S:
        since_s = 0.0
    return Holder(operator=str(values.get("operator", ""))[:100], since=since_s)


def table(values: Json, name: str) -> Json:
    """Return a JSON object inside another; an empty one if there is none."""
    found = values.get(name)
    return found if isinstance(found, dict) else {}


def phrases_of(values: Json) -> Json | None:
    """Return the table of phrases of an answer; None if it is none."""
    try:
        return _PHRASES.dump_python(_PHRASES.validate_python(values.get("phrases", {})))
    except ValidationError:
        return None


def cut_text(text: object) -> str:
    """Return a text of a bounded size; a phrase if it is not too long."""
    words = str(text)
    return words if len(words) <= _MOST_LETTERS else words[:_MOST_LETTERS]


def list_values(values: Json) -> Json:
    """Return `values` of a refusal: numbers, flags and texts, each of a bounded size."""
    plain = {
        name[:100]: value for name, value in table(values, "values").items() if isinstance(value, str | int | float)
    }
    return {name: cut_text(value) if isinstance(value, str) else value for name, value in list(plain.items())[:20]}


def make_order_view(machine: str, order: str, status: Json) -> OrderView:
    """Return the answer to an order, or to a stop of a machine."""
    return OrderView(machine=machine, order=order, mill=make_mill_view(status))


def make_mill_view(status: Json) -> Json:
    """Return the mill's state from its agent's status."""
    fields = table(status, "status")
    names = (
        "state",
        "detail",
        "code",
        "alarm",
        "work_mm",
        "machine_mm",
        "feed_mm_per_min",
        "spindle_rpm",
        "overrides",
        "position_trusted",
        "spindle_on",
        "pins",
        "controller",
    )
    return {name: fields.get(name) for name in names} | {
        "buffer_share": _compute_buffer_share(status),
        "connected": status.get("connected", False),
        "problem": status.get("problem", ""),
        "needs": status.get("needs", []),
        "latched": status.get("latched", ""),
        "zeroed": status.get("zeroed", ""),
        "zeroed_anew": status.get("zeroed_anew", ""),
        "stops": status.get("stops", 0),
        "setup": str(status.get("setup", ""))[:100],
        "phrases": phrases_of(status) or {},
    }


def _compute_buffer_share(status: Json) -> float | None:
    """Return how full the controller's receive buffer is kept, 0..1; None if the link does not report it."""
    used, room = table(status, "progress").get("bytes_in_flight"), table(status, "status").get("buffer_bytes")
    if not isinstance(used, int) or not isinstance(room, int) or room <= 0:
        return None
    return round(min(1.0, max(0.0, used / room)), 3)
