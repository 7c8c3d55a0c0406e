"""What POST /v1/estimates answers."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from phrases.phrase import Phrase, phrases_in
from service.http.schema import Body, Phrases
from service.server.schemas.jobs import ProblemField

_WALL = (  # 4 x 3 pixels
    "data:image/png;base64,"
    "iVBORw0KGgoAAAANSUhEUgAAAAQAAAADCAAAAACRn/EaAAAAF0lEQVR4XmNkCFWUZFwkxM/HeI+bhwsAEdcCY6432NIAAAAASUVORK5CYII="
)
_EXAMPLE: dict[str, Any] = {
    "relief_mm": 9.31,
    "max_slope_deg": 27.7,
    "thickness_ok": True,
    "throw_ok": True,
    "smallest_detail_mm": 2.5,
    "passes": [
        {"name": "rough", "tool": Phrase("ball {size}", size="R 3 (Ø 6 mm)"), "hours": 0.82},
        {"name": "finish", "tool": Phrase("ball {size}", size="R 3 (Ø 6 mm)"), "hours": 1.4},
    ],
    "planned": False,
    "exact": True,
    "hours": 2.22,
    "blur_mm": 1.2,
    "psnr_db": 24.5,
    "wall": _WALL,
    "blur_by": {"light_mm": 0.0, "milling_mm": 1.2},
    "refusals": [],
    "warnings": [Phrase("details under {detail_mm:.2g} mm will blur: the tool's marks", detail_mm=2.5)],
    "changes": [{"what": Phrase("passes as recommended"), "values": {"preset": "recommended"}}],
    "picture": {"width": 1920, "height": 1920},
    "spec": {"preset": "draft"},
}
ESTIMATE_EXAMPLE = {**_EXAMPLE, "phrases": phrases_in(_EXAMPLE)}


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
