"""Requests and answers of the routes about machines, their runs and control of them, except those of the mills'
agents.
"""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from pydantic import Field

from machines.runs import RunState
from service.http.schema import Body, Phrases, Sha256, Time, one_of
from service.milling.api import Check, Code, LiftMm, Values
from service.server.database.records import LOST, PREPARING, REFUSED
from service.server.schemas.jobs import JOB_ID

RunWord = Annotated[str, one_of((PREPARING, REFUSED, LOST, *(state.value for state in RunState)))]
PLAIN = r"^[^\x00-\x1f\x7f]+$"

RUN_ID = "0b0e7e0c-2f1d-4f6e-8f43-0a7b6a1c9d10"
_SETUP = {
    "tool": {"shape": "ball end mill", "radius_mm": 0.5, "spindle_rpm": 18000},
    "stock": {"width_mm": 116.0, "height_mm": 116.0, "thickness_mm": 40.0, "margin_mm": 8.0, "material": "pmma"},
    "zero": "X0 Y0: front left corner of the lens, 8 mm from the block's left and front edges; Z0: the block's top",
    "change": {
        "from_radius_mm": 3.0,
        "to_radius_mm": 0.5,
        "words": "change the tool from R 3 (Ø 6 mm) to R 0.5 (Ø 1 mm), set Z zero again; X and Y zero stay",
    },
}
_PROFILE = {
    "description": "the mill by the window",
    "dialect": "grbl",
    "travel_mm": [300.0, 180.0, 45.0],
    "max_rate_mm_per_min": [2000.0, 2000.0, 1000.0],
    "step_mm": 0.00125,
    "spindle_rpm": [0.0, 24000.0],
    "safe_z_mm": 5.0,
    "homing": True,
    "spindle": {"on_hold": "turns", "on_lost_link": "turns", "words": ["...", "..."]},
}
_MILL = {
    "state": "idle",
    "detail": "",
    "code": "",
    "alarm": 0,
    "work_mm": [0.0, 0.0, 5.0],
    "machine_mm": [-290.0, -170.0, -1.0],
    "feed_mm_per_min": 0.0,
    "buffer_share": 0.0,
    "spindle_rpm": 0.0,
    "overrides": [100, 100, 100],
    "position_trusted": True,
    "spindle_on": False,
    "pins": "",
    "controller": "Grbl 1.1h",
    "connected": True,
    "problem": "",
    "needs": [],
    "latched": "",
    "zeroed": "XYZ",
    "zeroed_anew": "Z",
    "setup": "9a0b4cf07d1e2c33",
    "phrases": {},
}


class NewRunBody(Body):
    """A program of a job. Without `program`: the next pass that this mill has not finished."""

    job: Annotated[UUID, Field(description="id of a job whose programs have been checked", examples=[JOB_ID])]
    program: Annotated[
        Annotated[int, Field(ge=1, le=99, strict=True)] | Annotated[str, Field(min_length=1, max_length=100)] | None,
        Field(description="number of the pass, or the program's file name", examples=[1]),
    ] = None
    lift_mm: LiftMm = None


class ProgramOfRun(Body):
    number: int
    name: str
    sha256: Sha256


class RunProgress(Body):
    """The part of a run that changes while it runs, so that the page shows it live."""

    id: str
    state: RunWord
    words: Annotated[str, Field(description="why it is in this state")]
    code: Code
    values: Values
    share: Annotated[float, Field(ge=0, le=1, description="certainly cut, by the time of its lines")]
    executed_line: int
    lines: int | None
    time_s: float | None
    time_left_s: float | None
    operator: str
    lift_mm: Annotated[
        float | None,
        Field(description="a dry pass: so much higher, spindle off. It never counts as cut; null: no dry pass"),
    ]
    phrases: Phrases


class LiveRun(RunProgress):
    """The part of a run that changes while it is on the mill."""

    machine: str
    open: Annotated[bool, Field(description="the mill is taken by this run")]
    unreachable: Annotated[bool, Field(description="the agent does not answer: this is what it said last")]
    unreachable_words: str
    recoveries: int
    warnings: list[str]
    travel_in_doubt: Annotated[bool, Field(description="one of the warnings: it may not fit the travel")]
    started_at: Time | None
    ended_at: Time | None


class RunView(LiveRun):
    """A program on a mill. state: preparing until the mill's agent has it, then the agent's own word."""

    job: str
    job_name: Annotated[str, Field(description="empty: the job is gone, or was not looked up")]
    program: ProgramOfRun
    setup: Annotated[
        dict[str, Any] | None,
        Field(description="tool, stock, zero, and the tool change before this pass", examples=[_SETUP]),
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


class PictureOfRun(Body):
    at: Time
    url: str


class TimelapseView(Body):
    pictures: Annotated[list[PictureOfRun], Field(description="of the camera beside the mill, oldest first")]


class AgentView(Body):
    reachable: bool
    words: Annotated[str, Field(description="why it cannot be reached")]
    code: Code
    values: Values
    phrases: Phrases


class OpenRun(RunProgress):
    """The part of a run that is shown with the mill."""

    job: str
    program: str


class Holder(Body):
    operator: str
    since: Time


class MachineView(Body):
    name: str
    remote: bool
    simulated: Annotated[bool, Field(description="there is no mill, only a model of one")]
    problem: Annotated[str, Field(description="what is wrong with its profile")]
    profile: Annotated[dict[str, Any] | None, Field(description="null: it cannot be read", examples=[_PROFILE])]
    agent: AgentView
    mill: Annotated[
        dict[str, Any] | None, Field(description="state and position, as its agent has them now", examples=[_MILL])
    ]
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
