"""What POST /v1/estimates answers."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from service.http.schema import Body, Phrases
from service.server.schemas.jobs import ProblemField


class PassEstimate(Body):
    name: str
    tool: str
    hours: Annotated[float, Field(ge=0)]


class BlurEstimate(Body):
    """Root mean squares on the screen."""

    light_mm: float
    milling_mm: float


class PictureSize(Body):
    width: int
    height: int


class ChangeView(Body):
    """Of the job: an estimate with it tells what it comes to."""

    what: str
    values: Annotated[dict[str, Any], Field(description="of the spec, by dotted key")]


class EstimateView(Body):
    relief_mm: Annotated[float, Field(description="highest minus lowest point of the lens")]
    max_slope_deg: float
    thickness_ok: Annotated[bool, Field(description="whether enough of the block is left under the deepest point")]
    throw_ok: Annotated[bool, Field(description="whether light gets out of slopes that can be milled")]
    smallest_detail_mm: Annotated[float, Field(description="on the screen; what is finer will blur")]
    passes: list[PassEstimate]
    planned: Annotated[bool, Field(description="the passes were planned for this estimate, on a coarse picture")]
    exact: Annotated[bool, Field(description="a lens as fine as the picture told it; else `exactly` tells more")]
    hours: float
    blur_mm: Annotated[float, Field(description="root mean square on the screen")]
    psnr_db: Annotated[float | None, Field(description="likeness of the milled picture; null: no pass finishes it")]
    wall: Annotated[
        str | None,
        Field(
            description="the picture that psnr_db is of, as the viewer sees it, by simulated light: the data URL of a "
            "grey PNG of at most 256 pixels along its longer side; null as psnr_db is"
        ),
    ]
    blur_by: BlurEstimate
    refusals: Annotated[list[ProblemField], Field(description="why the job would fail")]
    warnings: list[str]
    changes: Annotated[list[ChangeView], Field(description="single ones that may show more of the picture")]
    picture: PictureSize
    spec: Annotated[dict[str, Any], Field(description="the job spec with everything filled in")]
    phrases: Phrases
