"""What the routes about pairing and control of a mill take and answer.

The ranges are those of machines.driver, by which the mill's agent looks at everything again.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

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
)
from service.server.schemas.base import Body, Time
from service.server.schemas.runs import Holder, Scopes

_PERSON = r"^[^\W_][\w .,'@-]{0,59}$"
Person = Annotated[
    str,
    Field(min_length=1, max_length=60, pattern=_PERSON, description="who it is, for others to see", examples=["Ada"]),
]


def _within(low_high: tuple[float, float], **more: Any) -> Any:
    low, high = low_high
    return Field(ge=low, le=high, **more)


_Mm = Annotated[float, _within(JOG_MM)]


class WhoamiView(Body):
    name: str
    scopes: Scopes
    anonymous: Annotated[bool, Field(description="without a token, from this computer, where no token was ever made")]
    paired: Annotated[bool, Field(description="with a token that a page got for a code")]
    expires_at: Annotated[Time | None, Field(description="when the token ends; null: never")]


class PairingBody(Body):
    code: Annotated[str, Field(min_length=1, max_length=40, description="as printed", examples=["7K3D-0QXM-91TZ"])]
    name: Person


class PairingView(Body):
    token: Annotated[str, Field(description="shown this once; only its SHA-256 is kept")]
    name: Annotated[str, Field(description="of the token: the name given, or that and a number")]
    scopes: Scopes
    expires_at: Time


class ControlBody(Body):
    operator: Person
    take_over: Annotated[bool, Field(strict=True, description="from the one who has it; they are told")] = False


class ControlView(Holder):
    control: Annotated[str, Field(description="to be shown as Causticmill-Control with each order; tell nobody")]
    expires_s: Annotated[float, Field(description="without an order or another POST for so long, control is given up")]


class GrantBody(Body):
    stops: Annotated[
        int | None,
        Field(ge=0, description="`stops` of the mill as the person saw them; refused where it is more"),
    ] = None


class GrantView(Body):
    grant: Annotated[str, Field(description="to be sent as Causticmill-Grant with one order, at once")]
    valid_s: Annotated[float, Field(description="the agent carries nothing out under it later than that")]
    stops: Annotated[int, Field(description="how often this mill was stopped since its agent was started")]


class OrderView(Body):
    machine: str
    order: str
    mill: Annotated[dict[str, Any], Field(description="as in GET of the machine, just after the order was taken")]


class JogBody(Body):
    by_mm: Annotated[list[_Mm], Field(min_length=3, max_length=3, examples=[[1.0, 0.0, 0.0]])]
    feed_mm_per_min: Annotated[float, _within(JOG_FEED)] = 500.0


class ProbeBody(Body):
    """Down until it touches, work Z set there to the plate's thickness, up again."""

    depth_mm: Annotated[float, _within(PROBE_DEPTH_MM, examples=[20.0])]
    feed_mm_per_min: Annotated[float, _within(PROBE_FEED)] = 50.0
    plate_mm: Annotated[float, _within(PLATE_MM)] = 0.0
    retract_mm: Annotated[float, _within(RETRACT_MM)] = 2.0


class ProbeCornerBody(Body):
    """A plate on the block's front left corner is touched from above, from the left and from the front; then the work
    zero of X, Y and Z is set at once. The tool begins and ends over the plate, near the corner."""

    depth_mm: Annotated[float, _within(PROBE_DEPTH_MM, description="down to the plate, at most", examples=[20.0])]
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
        _within(MARGIN_MM, description="X0 Y0 lies so far inside the block's left and front edges", examples=[8.0]),
    ]
    feed_mm_per_min: Annotated[float, _within(PROBE_FEED, description="each touch is repeated slowly")] = 100.0
    aside_mm: Annotated[
        float, _within(BESIDE_MM, description="left, then forward of where it begins, where the tool goes down")
    ] = 20.0
    below_mm: Annotated[float, _within(BESIDE_MM, description="under the plate's top, where its sides are touched")] = (
        5.0
    )
    retract_mm: Annotated[float, _within(BESIDE_MM, description="over the plate's top, to go across")] = 5.0


class ZeroBody(Body):
    axes: Annotated[
        Literal["X", "Y", "Z", "XY", "XZ", "YZ", "XYZ"], Field(description="whose work zero is where the tool is")
    ] = "XYZ"


class OverrideBody(Body):
    what: Literal["feed", "rapid", "spindle"]
    percent: Annotated[int, _within(OVERRIDE_PERCENT, strict=True, description="rapid: 25, 50 or 100", examples=[90])]


class CheckBody(Body):
    on: Annotated[bool, Field(strict=True, description="the controller reads programs and moves nothing")]


class BlockBody(Body):
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
