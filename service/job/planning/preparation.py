"""The target of a lens: the picture as it is, or prepared for the detail that the wall can show (`image.prepare`)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from math import hypot
from pathlib import Path
from typing import Any

from optics.black import DARK, valley_leak
from optics.heightfield import Array
from optics.irradiance import target_irradiance
from optics.metrics import score_caustic
from optics.preparation import prepare_picture
from service.job.arrays import load_original
from service.job.files import plain
from service.job.spec.lens_task import bench_of, branch_of, source_spread_mm
from service.job.spec.model import JobSpec

_TILT_RAD = 0.02
"""Width of the distribution of surface tilts from tool marks and a finish, seen on finished lenses of usual mills. In
acrylic light is deflected by half of it, so that a wall at 100 mm shows details from 1 mm.
"""

_LEAST_PX = 2.0
"""Pixels of the smallest detail in a picture."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AimedPicture:
    """The target of a lens, in the work frame, mean 1, (ny, nx).

    original  : the picture as it is, in the same units; None if the target is that
    detail_mm : smallest detail on the screen for which it was prepared; None: no preparation was asked for
    black     : light of its darkest pixels as a share of the mean
    """

    target: Array
    original: Array | None = None
    detail_mm: float | None = None
    black: float = 0.0

    def figures(self) -> dict[str, Any]:
        """Return `image` of the report; empty if no preparation was asked for."""
        if self.detail_mm is None:
            return {}
        row = {"prepare": "detail", "prepare_detail_mm": self.detail_mm, "prepared": self.original is not None}
        if self.original is None:
            return row
        return {**row, "black_share": self.black, "against_original": score_against(self.target, self.original)}


def aim_at_picture(spec: JobSpec, linear: Array) -> AimedPicture:
    """Return the target of a job's picture (ny, nx), linear light, row 0 on top."""
    viewed_from = spec.optics.viewed_from
    original = target_irradiance(linear, viewed_from=viewed_from)
    if spec.image.prepare == "none":
        return AimedPicture(target=original)
    detail_mm = detail_to_prepare_for_mm(spec, columns=linear.shape[1])
    black = _black_share(spec, original)
    prepared = prepare_picture(linear, detail_mm * linear.shape[1] / spec.optics.screen_size_mm[0], black=black)
    if prepared is linear:
        return AimedPicture(target=original, detail_mm=detail_mm)
    target = target_irradiance(prepared, viewed_from=viewed_from)
    return AimedPicture(target=target, original=original, detail_mm=detail_mm, black=float(target.min()))


def detail_to_prepare_for_mm(spec: JobSpec, *, columns: int) -> float:
    """Return the smallest detail on the screen for which a picture of that many pixels across is prepared.

    It is the user's value, or else the blur of usual marks and of the source, at least two pixels.
    """
    if spec.image.prepare_detail_mm is not None:
        return spec.image.prepare_detail_mm
    optics = spec.optics
    bending = 2.0 if optics.surface == "mirror" else optics.refractive_index - 1.0
    disc_mm = source_spread_mm({"optics": optics.model_dump(mode="json")}, optics.throw_mm) or 0.0
    pixel_mm = optics.screen_size_mm[0] / columns
    return max(_LEAST_PX * pixel_mm, hypot(_TILT_RAD * bending * optics.throw_mm, disc_mm))


def scores_against_original(map_file: Path, irradiance: Array) -> dict[str, Any]:
    """Return {"against_original": PSNR and SSIM} of light (work frame, mean 1) on a wall, for a part of the report;
    empty if the lens does not aim at a prepared picture.

    map_file : the job's map.npz
    """
    original = load_original(map_file)
    return {} if original is None else {"against_original": score_against(irradiance, original)}


def score_against(irradiance: Array, original: Array) -> dict[str, float]:
    """Return PSNR and SSIM of light against the picture as it was given."""
    score = plain(asdict(score_caustic(irradiance, original)))
    return {name: score[name] for name in ("psnr_db", "seen_db", "ssim")}


def _black_share(spec: JobSpec, original: Array) -> float:
    """Return the share of the light that valleys send into the black parts of the picture; 0 without black parts."""
    radius_mm = spec.lens_radius_mm
    if radius_mm <= 0 or not (original < DARK * original.max()).any():
        return 0.0
    return valley_leak(replace(bench_of(spec), branch=branch_of(spec, original)), radius_mm)
