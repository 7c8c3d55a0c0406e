"""What the routes about the shop's tools take and answer."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from service.http.schema import Body

_NAME = r"^[^\x00-\x1f\x7f]{1,40}$"


class ToolView(Body):
    """An end mill; lengths in mm. Balls finish, what is flat roughs.

    Of two that do equally well a plan takes that of the lower cost_class.
    """

    name: Annotated[str, Field(pattern=_NAME, examples=["ball-r1"])]
    radius_mm: Annotated[float, Field(ge=0.05, le=25)]
    flutes: Annotated[int, Field(ge=1, le=8)] = 2
    flute_length_mm: Annotated[float, Field(ge=0.1, le=200, description="how high it cuts, from its tip")]
    shank_radius_mm: Annotated[float, Field(ge=0.1, le=50)]
    stick_out_mm: Annotated[float, Field(ge=0.5, le=300, description="from its tip to the chuck")]
    max_rpm: Annotated[float, Field(ge=100, le=200_000)] = 30_000
    cost_class: Annotated[int, Field(ge=1, le=3)] = 2
    corner_radius_mm: Annotated[
        float | None,
        Field(ge=0, le=25, description="0: flat; less than radius_mm: bull-nose; left out: a ball"),
    ] = None


class ToolsBody(Body):
    tools: Annotated[list[ToolView], Field(min_length=1, max_length=100)]


class ToolList(ToolsBody):
    own: Annotated[bool, Field(description="a list of the shop's own; false: the usual ones")]
