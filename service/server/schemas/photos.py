"""Findings from photographs of walls and of test pieces."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from service.http.schema import Body, Phrases


class PhotoFile(Body):
    name: str
    width: int
    height: int


class PlaceView(Body):
    """Where the predicted picture lies in the photograph, made smaller to photo_width x photo_height."""

    homography: Annotated[
        list[list[float]],
        Field(
            description="3 x 3, row by row: pixels of the predicted picture, from its upper left, to the photograph's"
        ),
    ]
    photo_width: int
    photo_height: int
    turned_deg: Annotated[float, Field(description="clockwise, beyond whole quarter turns, if the camera was level")]
    quarter_turns: int
    mirrored: bool
    correlation: float
    likeness: float
    confidence: Annotated[float, Field(ge=0, le=1)]
    overlap: Annotated[float, Field(description="share of the picture within the photograph")]
    clipped_share: float
    tone: Annotated[float, Field(description="exponent of the camera's own tones; 1: none")]


class AngleView(Body):
    deg: float
    deviation_deg: float
    told: bool


class WallView(Body):
    throw_off_mm: Annotated[float, Field(description="too far: positive")]
    throw_deviation_mm: float
    throw_told: Annotated[bool, Field(description="whether the photograph determines it at all")]
    tilt_x: AngleView
    tilt_y: AngleView


class LightView(Body):
    aslant_x: AngleView
    aslant_y: AngleView


class BlurView(Body):
    """Standard deviations on the wall."""

    beyond_foretold_mm: Annotated[float, Field(description="negative: sharper than predicted")]
    foretold_mm: float


class SurfaceTerm(Body):
    """One Legendre polynomial of the aperture, 1 in its corner."""

    order_x: int
    order_y: int
    um: float
    deviation_um: float
    told: bool


class SurfaceView(Body):
    peak_to_valley_um: float
    terms: list[SurfaceTerm]


class LikenessView(Body):
    as_foretold: float
    as_fitted: float


class FindingView(Body):
    code: str
    values: Annotated[dict[str, Any], Field(description="what `text` names")]
    text: str


class LookView(Body):
    photo: PhotoFile
    foretold: Annotated[Literal["finished", "milled", "designed"], Field(description="what it was compared with")]
    place: PlaceView
    wall: WallView
    light: LightView
    blur: BlurView
    surface: SurfaceView
    likeness: LikenessView
    findings: Annotated[list[FindingView], Field(description="in the order in which a person acts")]
    picture: Annotated[str, Field(description="base64 of a PNG: photograph, prediction, difference")]
    phrases: Phrases


class RippleView(Body):
    """One ripple of the test piece."""

    period_mm: float
    k_rad_per_mm: float
    share: Annotated[float, Field(description="of its amplitude that is left")]
    error: Annotated[float, Field(description="standard deviation of the share")]


class FinishFitView(Body):
    """H(k) = exp(-(k / k0)^order); ranges hold 68 % of the trials."""

    k0_rad_per_mm: float
    k0_range_rad_per_mm: list[float]
    order: float
    order_range: list[float]
    finished_half: Literal["left", "right"]
    ripples: list[RippleView]


class MillFitView(Body):
    z_noise_mm: Annotated[float, Field(description="standard deviation of a row's height")]
    z_noise_range_mm: Annotated[list[float | None], Field(description="null: no upper bound")]
    amplitude_over_programs: float
    ripples: list[RippleView]


class CouponWallView(Body):
    throw_mm: float
    error_mm: float


class CouponPhotoView(Body):
    blur_mm: float
    pixels_per_mm: float
    straight_light: Annotated[float, Field(description="light that goes straight, of the camera's white")]
    confidence: float
    mirrored: bool
    misfit: Annotated[float, Field(description="what is left over what was expected; about 1 where the model holds")]


class CouponView(Body):
    finish: FinishFitView
    mill: MillFitView
    wall: CouponWallView
    photograph: CouponPhotoView
    notes: list[FindingView]
    values: Annotated[dict[str, Any], Field(description="for a job's spec, by dotted key")]
    picture: Annotated[
        str, Field(description="base64 of a PNG: the photograph set straight, and what is left of ripples")
    ]
    phrases: Phrases
