"""What the routes about machines, their runs and control of them take and answer, as far as it is the server's own."""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from pydantic import Field

from machines.runs import RunState
from service.http.schema import Body, Phrases, Sha256, Time, one_of
from service.milling.api import Check, Code, Values
from service.server.database.states import LOST, PREPARING, REFUSED

RunWord = Annotated[str, one_of((PREPARING, REFUSED, LOST, *(state.value for state in RunState)))]
PLAIN = r"^[^\x00-\x1f\x7f]+$"

_JOB_ID = "6f1c1f0e-8a52-4f0c-9c0e-0d5f3a1b2c3d"


class NewRunBody(Body):
    """Which program of which job. Without `program`: the next pass that this mill has not finished."""

    job: Annotated[UUID, Field(description="id of a job whose programs have been checked", examples=[_JOB_ID])]
    program: Annotated[
        Annotated[int, Field(ge=1, le=99, strict=True)] | Annotated[str, Field(min_length=1, max_length=100)] | None,
        Field(description="number of the pass, or the program's file name", examples=[1]),
    ] = None


class ProgramOfRun(Body):
    number: int
    name: str
    sha256: Sha256


class LiveRun(Body):
    """The part of a run that changes while it is on the mill."""

    id: str
    machine: str
    state: RunWord
    open: Annotated[bool, Field(description="the mill is taken by this run")]
    words: Annotated[str, Field(description="why it is in this state")]
    code: Code
    values: Values
    unreachable: Annotated[bool, Field(description="the agent does not answer: this is what it said last")]
    unreachable_words: str
    share: Annotated[float, Field(ge=0, le=1, description="certainly cut, by lines")]
    executed_line: int
    lines: int | None
    time_s: float | None
    time_left_s: float | None
    operator: str
    recoveries: int
    warnings: list[str]
    travel_in_doubt: Annotated[bool, Field(description="one of the warnings: it may not fit the travel")]
    started_at: Time | None
    ended_at: Time | None
    phrases: Phrases


class RunView(LiveRun):
    """A program on a mill. state: preparing until the mill's agent has it, then the agent's own word."""

    job: str
    job_name: Annotated[str, Field(description="empty: the job is gone, or was not looked up")]
    program: ProgramOfRun
    setup: Annotated[
        dict[str, Any] | None, Field(description="tool, stock, zero, and the tool change before this pass")
    ]
    required_checks: Annotated[list[Check], Field(description="what :start or :recover needs to be confirmed")]
    left_out: Annotated[list[ProgramOfRun], Field(description="earlier passes that this mill has not finished")]
    next: Annotated[ProgramOfRun | None, Field(description="the pass that comes after this one")]
    created_by: str
    created_at: Time
    links: dict[str, str]


class RunList(Body):
    runs: list[RunView]
    next: Annotated[str | None, Field(description="address of the next page; null: this is the last")]


class AgentView(Body):
    reachable: bool
    words: Annotated[str, Field(description="why it cannot be reached")]
    code: Code
    values: Values
    phrases: Phrases


class OpenRun(Body):
    """The part of a run that one wants to see beside the mill."""

    id: str
    state: RunWord
    job: str
    program: str
    words: str
    code: Code
    values: Values
    share: Annotated[float, Field(ge=0, le=1, description="certainly cut, by lines")]
    executed_line: int
    lines: int | None
    time_s: float | None
    time_left_s: float | None
    operator: str
    phrases: Phrases


class Holder(Body):
    operator: str
    since: Time


class MachineView(Body):
    name: str
    remote: bool
    simulated: Annotated[bool, Field(description="there is no mill, only a model of one")]
    problem: Annotated[str, Field(description="what is wrong with its profile")]
    profile: dict[str, Any] | None
    agent: AgentView
    mill: Annotated[dict[str, Any] | None, Field(description="state and position, as its agent has them now")]
    run: Annotated[OpenRun | None, Field(description="the run that has this mill")]
    control: Annotated[Holder | None, Field(description="who may give orders to it at present; null: nobody")]
    links: dict[str, str]
    phrases: Phrases


class MachineList(Body):
    machines: list[MachineView]
    problems: Annotated[list[str], Field(description="what is wrong with the list of agents elsewhere")]
    phrases: Phrases


class ControlView(Holder):
    control: Annotated[str, Field(description="to be shown as Causticmill-Control with each order; tell nobody")]
    expires_s: Annotated[float, Field(description="without an order or another POST for so long, control is given up")]


class OrderView(Body):
    machine: str
    order: str
    mill: Annotated[dict[str, Any], Field(description="as in GET of the machine, just after the order was taken")]
