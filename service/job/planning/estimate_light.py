"""Predicts, for an estimate, the light of a job on the wall in the same way as the planner."""

from __future__ import annotations

from dataclasses import dataclass

from cam.planning.planner import Marks
from optics.heightfield import Array
from optics.metrics import psnr_db, seen_db, smallest_detail_mm
from service.job.planning.predicted_light import PictureLight

MOST_PIXELS = 512
"""Pixels along the longer side of the compared picture: finer detail hardly affects recognition."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedPicture:
    """The predicted picture and its target: (ny, nx) irradiance, work frame. The figures are those of this light; the
    smallest detail counts only the tool's marks.
    """

    light: Array
    target: Array
    psnr_db: float
    seen_db: float
    detail_mm: float


def describe_light(light: PictureLight, marks: Marks) -> PredictedPicture:
    """Return the picture that a plan's light predicts for its marks."""
    seen = light.picture(marks)
    return PredictedPicture(
        light=seen,
        target=light.target,
        psnr_db=psnr_db(seen, light.target),
        seen_db=seen_db(seen, light.target),
        detail_mm=smallest_detail_mm(seen, light.target, light.pixel_mm[1]),
    )
