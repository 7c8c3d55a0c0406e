"""From a photograph and the folder of a test piece to the files of the fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from optics.irradiance import picture_from_irradiance
from service.job import files as job_files
from service.job.coupon.findings import CouponResult, measure_photo, snippet
from service.job.coupon.photograph import Photo, read_photo
from service.job.coupon.piece import FIT, FIT_PICTURE, FIT_SNIPPET, PROFILES, coupon_of, require_coupon
from service.job.coupon.programs import load_predicted_piece
from service.job.finite_json import plain
from service.job.spec.loading import load_stored_job
from service.progress import Reporter, Stopwatch


def measure_coupon(photo: Path, folder: Path, *, reporter: Reporter) -> CouponResult:
    """Fit the photograph; coupon-fit.json, .png and .toml go into the folder. InputError where it says nothing."""
    job = require_coupon(folder)
    watch = Stopwatch(reporter)
    with watch.stage("photograph"):
        shot = read_photo(photo)
    with watch.stage("fit") as on_progress:
        result = fit_photo(str(photo), shot, folder, on_progress=on_progress)
    with watch.stage("figure"):
        picture = draw_fit(result, viewed_from_lens=job.spec.optics.viewed_from == "lens")
    job_files.write_bytes(folder / FIT_PICTURE, picture)
    job_files.write_bytes(folder / FIT_SNIPPET, snippet(result).encode())
    job_files.write_json(folder / FIT, plain({"photo": photo.name, **result.report()}))
    return result


def fit_photo(
    name: str, shot: Photo, folder: Path, *, on_progress: Callable[[float], None] | None = None
) -> CouponResult:
    """Return what a photograph says of the test piece in a folder. PhotoRefused where it says nothing."""
    job = load_stored_job(folder)
    predicted = load_predicted_piece(folder / PROFILES, coupon_of(job))
    return measure_photo(name, shot, predicted, job, on_progress=on_progress)


def draw_fit(result: CouponResult, *, viewed_from_lens: bool) -> bytes:
    """Draw coupon-fit.png."""
    from service.job.report.figures.photographs import coupon_fit_png  # what it stands on is slow to import

    picture, level = result.placed.picture, result.placed.level
    small = picture.light[: picture.light.shape[0] // 2 * 2, : picture.light.shape[1] // 2 * 2]
    small = small.reshape(small.shape[0] // 2, 2, small.shape[1] // 2, 2).mean(axis=(1, 3))
    seen = picture_from_irradiance(small, viewed_from="lens" if viewed_from_lens else "behind")
    x, y = picture.x_mm, picture.y_mm
    across = (x[-1], x[0]) if viewed_from_lens else (x[0], x[-1])
    return coupon_fit_png(
        np.asarray(seen / level),
        result.fit,
        extent_mm=(*across, y[0], y[-1]),
        notes=[note.code.replace("_", " ") for note in result.notes],
    )
