"""What the routes about jobs and estimates answer, and what a refusal looks like."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.http.schema import Body, Phrases, Sha256, Time, one_of
from service.server.database.records import PRIORITIES, JobState, StageState

JOB_ID = "6f1c1f0e-8a52-4f0c-9c0e-0d5f3a1b2c3d"
_SPEC = {"preset": "draft", "optics": {"width_mm": 40.0}}


class ProblemField(Body):
    field: str
    detail: str
    use: Annotated[float | None, Field(description="a value that would do in its place")] = None


class ProblemBody(BaseModel):
    """RFC 9457: what was refused, and why."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "type": "urn:causticmill:problem:spec",
                    "title": "Unusable value",
                    "status": 422,
                    "detail": "optics.width_mm: 0 is not allowed; allowed: a number from 0.5 to 2000 mm",
                    "field": "spec.optics.width_mm",
                }
            ]
        }
    )
    type: Annotated[str, Field(pattern=r"^urn:causticmill:problem:[a-z-]+$")]
    title: str
    status: int
    detail: str
    field: Annotated[str | None, Field(description="the part of the request it is about")] = None
    code: Annotated[str | None, Field(description="code of the refusal, for programs, if there is one")] = None
    values: Annotated[dict[str, Any] | None, Field(description="what `detail` names, beside `code`")] = None
    problems: Annotated[list[ProblemField] | None, Field(description="where there are several: all of them")] = None
    phrases: Phrases


class JobError(Body):
    """Why a job failed: the stage, one line, and the key of the spec it is about."""

    stage: str | None = None
    detail: str
    field: str | None = None
    phrases: Phrases


class ImageView(Body):
    sha256: Sha256
    bytes: int


class StageView(Body):
    name: str
    state: Annotated[str, one_of(("waiting", *StageState))]
    share: Annotated[float, Field(description="part of the whole job's time, as planned")]
    usual_s: Annotated[float, Field(description="what it took on two cores, on an idle computer")]
    seconds: float | None
    started_at: Time | None


class ProgramView(Body):
    number: int
    name: str
    sha256: Sha256
    bytes: int
    url: str


class JobSummary(Body):
    """A job as the list shows it."""

    id: str
    name: Annotated[str, Field(description="file name of the picture, made harmless")]
    state: Annotated[str, one_of(JobState)]
    stage: str | None
    progress: Annotated[float, Field(ge=0, le=1)]
    queue_position: Annotated[
        int | None, Field(description="1: starts next; 1000: that place or a later one; null: does not wait")
    ]
    priority: Annotated[str, one_of(PRIORITIES)]
    attempt: int
    cancel_requested: bool
    created_at: Time
    started_at: Time | None
    ended_at: Time | None
    error: JobError | None
    image: ImageView
    lens_mm: Annotated[tuple[float, float] | None, Field(description="width and height of the lens")]
    machine: Annotated[str | None, Field(description="profile of the mill that the job is for")]
    hours: Annotated[float | None, Field(description="of all programs; null: not known yet")]
    links: Annotated[
        dict[str, str],
        Field(description="`picture`: what the wall will show, small; until that is known, what it is to show"),
    ]
    etag: str


class JobView(JobSummary):
    """A whole job."""

    report: Annotated[dict[str, Any] | None, Field(description="report.json of the stages that are done")]
    spec: Annotated[dict[str, Any], Field(description="the resolved spec: every value that counted", examples=[_SPEC])]
    stages: list[StageView]
    programs: Annotated[list[ProgramView], Field(description="one per pass, as soon as all have been checked")]


class JobList(Body):
    jobs: list[JobSummary]
    next: Annotated[str | None, Field(description="address of the next page; null: this is the last")]


class ArtifactView(Body):
    name: str
    sha256: Sha256
    bytes: int
    stage: str
    media_type: str
    url: str


class ArtifactList(Body):
    artifacts: list[ArtifactView]


class RequestView(Body):
    """What a job was made from."""

    name: str
    spec: Annotated[
        dict[str, Any],
        Field(description="only the keys that must be given; the rest follows from them", examples=[_SPEC]),
    ]
    image: Annotated[str, Field(description="address of the picture")]


class ProfileMill(Body):
    name: str
    simulated: bool


_Triple = Annotated[list[float] | None, Field(min_length=3, max_length=3, description="X, Y, Z")]
_Pair = Annotated[list[float] | None, Field(min_length=2, max_length=2, description="slowest, fastest")]


class ProfileBody(Body):
    """A mill of the shop: what it is like, and its own figures where they differ. See docs/mill.md for all of them."""

    extends: Annotated[str, Field(max_length=80, description="the built-in profile it is like", examples=["grbl"])]
    description: Annotated[str | None, Field(max_length=300)] = None
    travel_mm: _Triple = None
    max_rate_mm_per_min: _Triple = None
    acceleration_mm_per_s2: _Triple = None
    spindle_rpm: _Pair = None
    step_mm: Annotated[float | None, Field(description="smallest move of an axis")] = None
    z_noise_mm: Annotated[float | None, Field(description="sigma of a row's height; a test piece measures it")] = None
    collet_mm: Annotated[float | None, Field(description="thickest shank")] = None
    spindle_w: float | None = None
    removal_cm3_per_min: Annotated[float | None, Field(description="the most that the frame stands")] = None


class ProfileView(Body):
    """A kind of mill that programs can be made for."""

    name: str
    description: str
    dialect: str
    travel_mm: Annotated[list[float], Field(description="X, Y, Z")]
    max_rate_mm_per_min: Annotated[list[float], Field(description="X, Y, Z")]
    spindle_rpm: Annotated[list[float], Field(description="slowest, fastest")]
    step_mm: float
    z_noise_mm: float
    collet_mm: float | None
    spindle_w: float | None
    mills: Annotated[list[ProfileMill], Field(description="of this server; programs made so are for them")]
    built_in: bool
    stated: Annotated[
        ProfileBody | None, Field(description="what was put there; null: built in, or written by hand in its file")
    ]


class ProfileList(Body):
    profiles: list[ProfileView]
    phrases: Phrases


class Root(Body):
    """What answers here, and addresses to begin with."""

    name: Literal["causticmill"]
    version: str
    links: dict[str, str]


class Alive(Body):
    alive: Literal[True]


class Ready(Body):
    """Each part by its word: `ok`, or what is wrong with it."""

    ready: bool
    checks: dict[str, str]


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
    """A change of the job; an estimate with the change shows its effect."""

    what: str
    values: Annotated[dict[str, Any], Field(description="of the spec, by dotted key")]


class PlanView(Body):
    """A plan to choose from; its figures take the place of the estimate's."""

    is_chosen: Annotated[bool, Field(description="the plan that the job follows otherwise")]
    hours: Annotated[float, Field(ge=0)]
    hand_min: Annotated[float | None, Field(description="work by hand after milling; null: none, or not known")]
    passes: list[PassEstimate]
    psnr_db: float
    seen_db: float
    smallest_detail_mm: float
    wall: str
    spec: Annotated[dict[str, Any], Field(description="merged into the spec, table by table, it selects this plan")]


class EstimateView(Body):
    relief_mm: Annotated[float, Field(description="highest minus lowest point of the lens")]
    max_slope_deg: float
    thickness_ok: Annotated[bool, Field(description="whether enough of the block is left under the deepest point")]
    throw_ok: Annotated[bool, Field(description="whether light gets out of slopes that can be milled")]
    smallest_detail_mm: Annotated[float, Field(description="on the screen; what is finer will blur")]
    passes: list[PassEstimate]
    planned: Annotated[bool, Field(description="the passes were planned for this estimate, on a coarse picture")]
    exact: Annotated[bool, Field(description="from a lens as fine as the picture; if not, `exactly` gives more")]
    hours: float
    blur_mm: Annotated[float, Field(description="root mean square on the screen")]
    psnr_db: Annotated[float | None, Field(description="likeness of the milled picture; null: no pass finishes it")]
    seen_db: Annotated[float | None, Field(description="the same as an eye sees it, -10 log10(1 - correlation)")]
    wall: Annotated[
        str | None,
        Field(
            description="the picture that psnr_db is of, as the viewer sees it, by simulated light: the data URL of a "
            "grey PNG of at most 256 pixels along its longer side; null as psnr_db is"
        ),
    ]
    blur_by: BlurEstimate
    plans: Annotated[
        list[PlanView],
        Field(
            description="the quickest, the chosen and the best, each once, quickest first; none of a first look, or of "
            "given passes"
        ),
    ]
    refusals: Annotated[list[ProblemField], Field(description="why the job would fail")]
    warnings: list[str]
    changes: Annotated[list[ChangeView], Field(description="single ones that may show more of the picture")]
    picture: PictureSize
    spec: Annotated[dict[str, Any], Field(description="the job spec with everything filled in")]
    phrases: Phrases
