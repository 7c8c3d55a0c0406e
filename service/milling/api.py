"""Requests and answers of a mill's agent: orders, confirmations of a start, and views of runs.

The agent and its callers use the same models. Only the agent validates an order outside a run: the job server passes it
on unchanged. The ranges are those of machines.driver.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import Field

from machines.driver import (
    BESIDE_MM,
    CORNER_PLATE_MM,
    CUTTER_RADIUS_MM,
    HAND_RPM,
    JOG_FEED,
    JOG_MM,
    MARGIN_MM,
    OVERRIDE_PERCENT,
    PLATE_MM,
    PROBE_DEPTH_MM,
    PROBE_FEED,
    RETRACT_MM,
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
from machines.gcode.lift import LIFT_MM
from machines.mill.mill import Mill
from machines.runs import RunState
from phrases.phrase import Phrase
from service.http.problems import Problem
from service.http.schema import Body, Phrases

Check = Literal["tool", "zero", "stock", "clear", "position", "order"]
Code = Annotated[str, Field(description="the same as `words`, for programs; empty: there are only the words")]
Values = Annotated[dict[str, Any], Field(description="what the words name, by `code`")]

_LATEST_S = 4e9  # year 2096: later values are not times
_PERSON = r"^[^\W_][\w .,'@-]*$"  # a count of such classes of Unicode would take megabytes in each model
Person = Annotated[
    str,
    Field(min_length=1, max_length=60, pattern=_PERSON, description="who it is, for others to see", examples=["Ada"]),
]


def _within(low_high: tuple[float, float], **more: Any) -> Any:
    low, high = low_high
    return Field(ge=low, le=high, strict=True, **more)


_Mm = Annotated[float, _within(JOG_MM)]
LiftMm = Annotated[
    float | None,
    _within(
        LIFT_MM, description="a dry pass: the whole program raised by this, spindle and coolant off; it cuts nothing"
    ),
]


class ControlBody(Body):
    operator: Person
    take_over: Annotated[bool, Field(strict=True, description="from the person who has it, who is notified")] = False


class GrantBody(Body):
    stops: Annotated[
        int | None,
        Field(ge=0, strict=True, description="`stops` of the mill as the person saw them; refused where it is more"),
    ] = None


class GrantView(Body):
    grant: Annotated[str, Field(description="to be sent as Causticmill-Grant with one order, at once")]
    valid_s: Annotated[float, Field(description="the agent carries out nothing under it after that")]
    stops: Annotated[int, Field(description="how often this mill was stopped since its agent was started")]


class LeaseBody(Body):
    """Control of the mill for `operator`, whom the server knows as `principal`."""

    operator: Annotated[str, Field(max_length=100, pattern=r"\S")]
    principal: Annotated[str, Field(max_length=200, pattern=r"\S")]
    take_over: Annotated[bool, Field(strict=True)]


class FetchBody(Body):
    """A program to be brought from the job server, where `token` is shown."""

    url: Annotated[str, Field(max_length=2000, pattern=r"\S")]
    sha256: Annotated[str, Field(max_length=500)]
    token: Annotated[str, Field(max_length=500)] | None = None


class ParkBody(Body):
    """A run of a program that the agent has. key: the second request with the same one makes no second run; lift_mm: a
    dry pass of it, raised by this with the spindle off.
    """

    program: Annotated[str, Field(max_length=500)]
    name: Annotated[str, Field(max_length=200)] = ""
    key: Annotated[str, Field(max_length=100)] = ""
    lift_mm: LiftMm = None


class ConfirmationBody(Body):
    """A person's statement, by name, that these things were checked at the mill."""

    operator: Annotated[str, Field(min_length=1, max_length=100, pattern=r"\S", examples=["Ada"])]
    checks: Annotated[
        list[Check],
        Field(max_length=12, description="as `required_checks`", examples=[["tool", "zero", "stock", "clear"]]),
    ]


class StartBody(ConfirmationBody):
    setup: Annotated[
        str, Field(max_length=100, description="the mill's `setup` as it was seen; refused where it is another by now")
    ] = ""


class RecoverBody(ConfirmationBody):
    plan: Annotated[
        str, Field(max_length=100, description="`plan` of the recovery that was read; else the one shown to you last")
    ] = ""


class PastOrder(Body):
    number: int
    at_s: float
    kind: str
    words: str
    code: Code | None = None
    values: Values | None = None
    answer: Annotated[dict[str, Any] | None, Field(description="what a command gave, by name")] = None
    by: str | None = None
    phrases: Phrases
    from_: Annotated[str | None, Field(alias="from")] = None


class PastOrders(Body):
    orders: list[PastOrder]
    next: Annotated[int | None, Field(description="`before` of the next page")]


class RecoveryView(Body):
    """How an interrupted run would go on: the needs that must be met first, and the lines that would be sent."""

    run: str
    executed_line: int
    resume_line: int
    overlap_line: int
    recut_lines: int
    position_mm: list[float] | None
    plan: Annotated[str, Field(description="to be sent with :recover: the person's confirmation is for this plan")]
    blocks: list[str]
    ready: bool
    refusals: list[str]
    needs: Annotated[list[dict[str, Any]], Field(description="what has to be done first: code, values, words")]
    differences: list[str]
    zero_back: Annotated[str, Field(description="a block that sets the work zero the run was cut at; or empty")] = ""
    words: list[str]
    phrases: Phrases


_Seconds = Annotated[float, Field(ge=0, le=1e12, strict=True)]
_Moment = Annotated[float, Field(ge=0, le=_LATEST_S, strict=True)]
_Lines = Annotated[int, Field(ge=0, le=10**12, strict=True)]


class RunReply(Body):
    """An agent's report on a run (machines.runs.RunReport), as far as others rely on it."""

    share: Annotated[float, Field(ge=0, le=1, strict=True)] = 0.0
    executed_line: _Lines = 0
    lines: _Lines | None = None
    recoveries: Annotated[int, Field(ge=0, le=10**9, strict=True)] = 0
    time_s: _Seconds | None = None
    time_left_s: _Seconds | None = None
    created_s: _Moment | None = None
    started_s: _Moment | None = None
    ended_s: _Moment | None = None
    words: str = ""
    code: str = ""
    operator: str = ""
    warnings: Annotated[list[str], Field(default_factory=list)]
    values: Annotated[dict[str, Any], Field(default_factory=dict)]
    phrases: Phrases
    travel_in_doubt: Annotated[bool, Field(strict=True)] = False
    id: Annotated[str, Field(min_length=1, max_length=100, pattern="^[^/]*$")]
    state: RunState


class OrderBody(Body):
    """An order outside a run."""

    def command(self) -> Command:
        """Return the mill's command. Problem 422 if its values do not go together."""
        raise NotImplementedError

    def make_act(self) -> Callable[[Mill], None]:
        """Return what the mill's thread carries out. Problem 422 as `command`."""
        command = self.command()
        return lambda mill: mill.command(command)


class JogBody(OrderBody):
    by_mm: Annotated[list[_Mm], Field(min_length=3, max_length=3, examples=[[1.0, 0.0, 0.0]])]
    feed_mm_per_min: Annotated[float, _within(JOG_FEED)] = 500.0

    def command(self) -> Command:
        x_mm, y_mm, z_mm = self.by_mm
        return Jog(by_mm=(x_mm, y_mm, z_mm), feed_mm_per_min=self.feed_mm_per_min)


class ZeroWayBody(OrderBody):
    axes: Annotated[
        Literal["XY", "XYZ"], Field(description="XY: over it, at a safe height; XYZ: then down to Z0, spindle off")
    ] = "XY"
    feed_mm_per_min: Annotated[float, _within(JOG_FEED)] = 1000.0

    def make_act(self) -> Callable[[Mill], None]:
        return lambda mill: mill.go_to_zero(self.axes, self.feed_mm_per_min)


class FrameBody(OrderBody):
    program: Annotated[
        str, Field(max_length=100, description="`sha256` of the program that waits, as the person saw it")
    ]
    feed_mm_per_min: Annotated[float, _within(JOG_FEED)] = 1000.0

    def make_act(self) -> Callable[[Mill], None]:
        return lambda mill: mill.frame(self.program, self.feed_mm_per_min)


class ProbeBody(OrderBody):
    """Down until it touches, work Z set there to the plate's thickness, up again."""

    depth_mm: Annotated[float, _within(PROBE_DEPTH_MM, examples=[20.0])]
    feed_mm_per_min: Annotated[float, _within(PROBE_FEED)] = 50.0
    plate_mm: Annotated[float, _within(PLATE_MM)] = 0.0
    retract_mm: Annotated[float, _within(RETRACT_MM)] = 2.0

    def command(self) -> Command:
        return ProbeZ(**dict(self))


class ProbeCornerBody(OrderBody):
    """A plate on the block's front left corner is touched from above, from the left and from the front; then the work
    zero of X, Y and Z is set at once. The tool begins and ends over the plate, near the corner."""

    depth_mm: Annotated[float, _within(PROBE_DEPTH_MM, description="greatest way down to the plate", examples=[20.0])]
    plate_mm: Annotated[float, _within(CORNER_PLATE_MM, description="of the plate, on the block", examples=[10.0])]
    wall_x_mm: Annotated[
        float,
        _within(CORNER_PLATE_MM, description="from the block's left edge to the plate's face", examples=[6.0]),
    ]
    wall_y_mm: Annotated[
        float, _within(CORNER_PLATE_MM, description="from its front edge to the plate's face", examples=[6.0])
    ]
    cutter_radius_mm: Annotated[
        float, _within(CUTTER_RADIUS_MM, description="of the cutter or pin that touches", examples=[1.5])
    ]
    margin_mm: Annotated[
        float,
        _within(MARGIN_MM, description="distance of X0 Y0 inside the block's left and front edges", examples=[8.0]),
    ]
    feed_mm_per_min: Annotated[float, _within(PROBE_FEED, description="each touch is repeated slowly")] = 100.0
    aside_mm: Annotated[
        float, _within(BESIDE_MM, description="left, then forward of where it begins, where the tool goes down")
    ] = 20.0
    below_mm: Annotated[float, _within(BESIDE_MM, description="under the plate's top, where its sides are touched")] = (
        5.0
    )
    retract_mm: Annotated[float, _within(BESIDE_MM, description="over the plate's top, to go across")] = 5.0

    def command(self) -> Command:
        return ProbeCorner(**dict(self))


class ZeroBody(OrderBody):
    axes: Annotated[
        Literal["X", "Y", "Z", "XY", "XZ", "YZ", "XYZ"], Field(description="whose work zero is where the tool is")
    ] = "XYZ"

    def command(self) -> Command:
        return SetZero(self.axes)


class OverrideBody(OrderBody):
    what: Literal["feed", "rapid", "spindle"]
    percent: Annotated[int, _within(OVERRIDE_PERCENT, description="rapid: 25, 50 or 100", examples=[90])]

    def command(self) -> Command:
        if self.what == "rapid" and self.percent not in (25, 50, 100):
            raise Problem(422, f"percent is {self.percent}; allowed: 25, 50, 100", field="percent")
        return Override(self.what, self.percent)


class SpindleBody(OrderBody):
    """By hand, outside programs. It goes off when control ends, and with each hold and abort."""

    on: Annotated[bool, Field(strict=True)]
    rpm: Annotated[float, _within(HAND_RPM, description="within the mill's own speeds; for `on`", examples=[12e3])] = (
        0.0
    )

    def make_act(self) -> Callable[[Mill], None]:
        if self.on is (self.rpm == 0.0):
            raise Problem(
                422, Phrase("rpm must be above 0 to switch it on, and is not given to switch it off"), field="rpm"
            )
        return lambda mill: mill.switch_spindle(self.rpm if self.on else None)


class CheckBody(OrderBody):
    on: Annotated[bool, Field(strict=True, description="the controller reads programs and moves nothing")]

    def command(self) -> Command:
        return CheckMode(self.on)


class BlockBody(OrderBody):
    text: Annotated[
        str,
        Field(
            min_length=1, max_length=255, pattern=r"^[ -~]*[!-~][ -~]*$", description="one line of G-code",
            examples=["G0 Z5"],
        ),
    ]  # fmt: skip
    confirm: Annotated[
        bool,
        Field(
            strict=True,
            description="it is meant, though it changes what protects the mill or where its zeros are. Without this "
            "such a line is refused: 409, `code` is `confirm`, `effect` says what it would do",
        ),
    ] = False

    def command(self) -> Command:
        if any(character in self.text for character in "?!~"):
            raise Problem(422, Phrase("text must be one line of plain G-code, without ? ! ~"), field="text")
        return SendBlock(self.text)


ORDERS: dict[str, type[OrderBody]] = {
    "jog": JogBody,
    "go-to-zero": ZeroWayBody,
    "frame": FrameBody,
    "probe": ProbeBody,
    "probe-corner": ProbeCornerBody,
    "zero": ZeroBody,
    "override": OverrideBody,
    "spindle": SpindleBody,
    "check": CheckBody,
    "block": BlockBody,
}
PLAIN_ORDERS: dict[str, Callable[[], Command]] = {
    "home": Home,
    "unlock": Unlock,
    "reset": Reset,
    "trust-position": TrustPosition,
    "settings": ReadSettings,
}
"""Orders without a body."""
