"""Evaluates a photograph of a test piece from the piece's folder: figures and the files of the fit, or the reason why
the photograph is of no use. All sentences stand in one table.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optics.coupon.fit import K0_RANGE, FinishFit, fit_finish, misfit_as_milled
from optics.coupon.fringes import nominal_lever_mm
from optics.coupon.grain import RowErrors, fit_row_errors, measure_grain
from optics.coupon.layout import Half
from optics.coupon.reading import Fold, fold_all
from optics.finish import Finish
from optics.irradiance import picture_from_irradiance
from phrases.phrase import Phrase
from service.job import files as job_files
from service.job.coupon.photograph import Photo, Placed, place_photo, read_photo
from service.job.coupon.piece import FIT, FIT_PICTURE, FIT_SNIPPET, PROFILES, coupon_of, require_coupon
from service.job.coupon.programs import TEMPLATES_RAD_PER_MM, PredictedPiece, load_predicted_piece
from service.job.files import plain
from service.job.photo.findings import Finding, UselessPhotoError
from service.job.spec.finish import NONE
from service.job.spec.loading import load_stored_job
from service.job.spec.resolve import ResolvedJob, cam_passes_of
from service.progress import Reporter, Stopwatch

HALVES: tuple[Half, Half] = ("left", "right")
_SURE = 0.5  # of the registration's confidence
_LEAST_PIXELS_PER_MM, _LEAST_LEVEL = 14.0, 0.015
_LEAST_RIPPLES = 3
_AS_MILLED, _WORSE = 2.5, 1.4  # largest misfit of a half that is as milled; misfit ratio of the two
_FAINTER = 0.7
_NOTHING_LEFT_OFF = 0.9  # of the shortest ripples: a half that keeps that much was not finished
_MOST_BLUR_MM = 0.2
_WALL_OFF = 0.06

SENTENCES: dict[str, Callable[[Mapping[str, float]], Phrase]] = {
    "not_a_coupon": lambda v: Phrase(
        "the photograph shows no test piece (likeness {confidence:.2f}); allowed: the light of this test piece on "
        "its screen, all of it, in a dark room", **v
    ),
    "too_small": lambda v: Phrase(
        "the piece is {pixels_per_mm:.0f} pixels per mm in the photograph; allowed: at least {least:.0f}, "
        "{across:.0f} pixels from its left rim to its right one", **v
    ),
    "too_dark": lambda v: Phrase(
        "the light of the piece is {level:.3f} of the camera's white; allowed: from {least:g}: expose longer", **v
    ),
    "clipped": lambda v: Phrase(
        "{share:.0%} of the fringes are white in the photograph, so that {ripples} of 8 ripples are left to "
        "measure; allowed: an exposure one or two stops shorter", **v
    ),
    "no_fringes": lambda v: Phrase(
        "neither half shows the ripples as they were milled (misfit {misfit:.1f}); allowed: one half left as "
        "milled, a lamp without lens or reflector at least 2 m away, the wall at {throw_mm:g} mm", **v
    ),
    "blurred": lambda v: Phrase(
        "the photograph is blurred by {blur_mm:.2f} mm; allowed: up to {most_mm:g} mm: focus on the paper, take a "
        "smaller or farther lamp", **v
    ),
    "not_finished": lambda v: Phrase(
        "both halves are as they were milled: all ripples are there; allowed: one half finished"
    ),
    "right_finished": lambda v: Phrase("the right half was finished, not the left one: treated as such"),
    "mirrored": lambda v: Phrase(
        "the photograph was taken from the other side of the paper, or is mirrored: treated as such"
    ),
    "wall_off": lambda v: Phrase(
        "the wall stood {off_mm:+.1f} mm off: at {throw_mm:.1f} mm, where {nominal_mm:g} mm were planned; the "
        "finish is measured all the same", **v
    ),
    "too_light": lambda v: Phrase(
        "the finish takes hardly anything off even the shortest ripple: k0 is above {least:.0f} rad/mm, its figure "
        "uncertain", **v
    ),
    "too_strong": lambda v: Phrase(
        "the finish takes most off even the longest ripple: k0 is below {most:.1f} rad/mm, its figure uncertain", **v
    ),
    "poor_fit": lambda v: Phrase(
        "fringes and model differ {misfit:.1f} times as much as the photograph explains: the figures may be off by "
        "more than they say", **v
    ),
    "short_lost": lambda v: Phrase(
        "{count} of 8 ripples cannot be seen in this photograph (too white, or too fine for its blur)", **v
    ),
}  # fmt: skip


class CouponFinding(Finding):
    """What a photograph of the test piece shows."""

    sentences = SENTENCES


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CouponResult:
    """All that one photograph says."""

    fit: FinishFit
    rows: RowErrors
    finished: Half
    placed: Placed
    notes: tuple[CouponFinding, ...]

    def values(self) -> dict[str, Any]:
        """Return the values that follow for a job's spec, by dotted key."""
        return {
            "finish.process": NONE,
            "finish.k0_rad_per_mm": float(f"{self.fit.k0_rad_per_mm:.3g}"),
            "finish.order": float(f"{self.fit.order:.2g}"),
            "machine.z_noise_mm": float(f"{self.rows.z_noise_mm:.2g}"),
        }

    def report(self) -> dict[str, Any]:
        """Return the result as coupon-fit.json holds it."""
        fit, found = self.fit, self.placed.registration
        return {
            "finish": {
                "k0_rad_per_mm": fit.k0_rad_per_mm,
                "k0_range_rad_per_mm": list(fit.k0_range),
                "order": fit.order,
                "order_range": list(fit.order_range),
                "finished_half": self.finished,
                "ripples": [asdict(one) for one in fit.ripples],
            },
            "mill": {
                "z_noise_mm": self.rows.z_noise_mm,
                "z_noise_range_mm": [self.rows.low_mm, self.rows.high_mm],
                "amplitude_over_programs": fit.mill_gain,
                "ripples": [asdict(one) for one in fit.milled_ripples],
            },
            "wall": {"throw_mm": fit.throw_mm, "error_mm": fit.throw_error_mm},
            "photograph": {
                "blur_mm": fit.blur_mm,
                "pixels_per_mm": self.placed.pixels_per_mm,
                "straight_light": self.placed.level,
                "confidence": found.confidence,
                "mirrored": found.mirrored,
                "misfit": fit.misfit,
            },
            "notes": [one.plain() for one in self.notes],
        }


def measure_coupon(photo: Path, folder: Path, *, reporter: Reporter) -> CouponResult:
    """Fit the photograph and write coupon-fit.json, .png and .toml into the folder. InputError if it is of no use."""
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
    """Evaluate a photograph of the test piece in a folder. UselessPhotoError if it is of no use."""
    job = load_stored_job(folder)
    predicted = load_predicted_piece(folder / PROFILES, coupon_of(job))
    return measure_photo(name, shot, predicted, job, on_progress=on_progress)


def draw_fit(result: CouponResult, *, viewed_from_lens: bool) -> bytes:
    """Draw coupon-fit.png."""
    from service.job.report.figures.photographs import coupon_fit_png  # its dependencies are slow to import

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


def measure_photo(
    name: str,
    photo: Photo,
    predicted: PredictedPiece,
    job: ResolvedJob,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> CouponResult:
    """Evaluate the photograph of that test piece. UselessPhotoError if it is of no use."""
    on_progress = on_progress or (lambda share: None)
    coupon, template = coupon_of(job), 0
    placed = _place(name, photo, predicted, template, job)
    on_progress(0.4)
    finished, folds = _choose_finished_half(name, placed, predicted, job)
    fit = fit_finish(coupon, predicted.profiles, folds, finished=finished)
    on_progress(0.6)
    if finished == "left" and (nearest := _nearest_template(fit)) != template:
        placed = _place(name, photo, predicted, nearest, job)
        folds = fold_all(placed.picture, coupon)
        fit = fit_finish(coupon, predicted.profiles, folds, finished=finished)
    on_progress(0.9)
    if fit.blur_mm > _MOST_BLUR_MM:
        raise UselessPhotoError(name, CouponFinding("blurred", {"blur_mm": fit.blur_mm, "most_mm": _MOST_BLUR_MM}))
    if np.median([one.share for one in fit.ripples[-3:]]) >= _NOTHING_LEFT_OFF:
        raise UselessPhotoError(name, CouponFinding("not_finished"))
    rows = _row_errors(placed, predicted, job, fit, finished)
    on_progress(1.0)
    notes = tuple(_notes(fit, placed, finished, job))
    return CouponResult(fit=fit, rows=rows, finished=finished, placed=placed, notes=notes)


def _place(name: str, photo: Photo, predicted: PredictedPiece, template: int, job: ResolvedJob) -> Placed:
    try:
        placed = place_photo(photo, predicted.templates[template], viewed_from=job.spec.optics.viewed_from)
    except ValueError:  # no light in it
        raise UselessPhotoError(name, CouponFinding("not_a_coupon", {"confidence": 0.0})) from None
    found = placed.registration
    if found.confidence < _SURE:
        raise UselessPhotoError(name, CouponFinding("not_a_coupon", {"confidence": found.confidence}))
    if placed.pixels_per_mm < _LEAST_PIXELS_PER_MM:
        values = {"pixels_per_mm": placed.pixels_per_mm, "least": _LEAST_PIXELS_PER_MM}
        raise UselessPhotoError(name, CouponFinding("too_small", {**values, "across": 40 * _LEAST_PIXELS_PER_MM}))
    if placed.level < _LEAST_LEVEL:
        raise UselessPhotoError(name, CouponFinding("too_dark", {"level": placed.level, "least": _LEAST_LEVEL}))
    return placed


def _choose_finished_half(
    name: str, placed: Placed, predicted: PredictedPiece, job: ResolvedJob
) -> tuple[Half, tuple[Fold, ...]]:
    """Return which half was finished; if both could be, the one with much fainter fringes, else the left one."""
    coupon = coupon_of(job)
    folds = fold_all(placed.picture, coupon)
    for half in HALVES:
        own = [fold for fold in folds if fold.half == half and fold.strip.kind == "ripple"]
        ripples = sum(fold.is_usable for fold in own)
        if ripples < _LEAST_RIPPLES:
            share = float(np.mean([fold.clipped for fold in own]))
            raise UselessPhotoError(name, CouponFinding("clipped", {"share": share, "ripples": ripples}))
    misfits = {half: misfit_as_milled(coupon, predicted.profiles, folds, half) for half in HALVES}
    if min(misfits.values()) > _AS_MILLED:
        values = {"misfit": min(misfits.values()), "throw_mm": job.spec.optics.throw_mm}
        raise UselessPhotoError(name, CouponFinding("no_fringes", values))
    if max(misfits.values()) > _WORSE * min(misfits.values()):
        return max(HALVES, key=lambda half: misfits[half]), folds
    fringes = {half: sum(fold.fringe for fold in folds if fold.half == half and fold.is_usable) for half in HALVES}
    return ("right" if fringes["right"] < _FAINTER * fringes["left"] else "left"), folds


def _nearest_template(fit: FinishFit) -> int:
    """Return the predicted finish that halves a ripple of about the same wavelength."""
    half = fit.k0_rad_per_mm * math.log(2.0) ** (1 / fit.order - 0.5)
    return min(range(len(TEMPLATES_RAD_PER_MM)), key=lambda n: abs(math.log(TEMPLATES_RAD_PER_MM[n] / half)))


def _row_errors(
    placed: Placed, predicted: PredictedPiece, job: ResolvedJob, fit: FinishFit, finished: Half
) -> RowErrors:
    y, across = predicted.across
    clean = np.interp(placed.picture.y_mm, y, across)
    passed, coupon = cam_passes_of(job.spec)[-1], coupon_of(job)
    return fit_row_errors(
        measure_grain(placed.picture, clean, "right" if finished == "left" else "left"),
        radius_mm=passed.radius_mm,
        pitch_mm=passed.pitch_mm,
        lever_mm=nominal_lever_mm(coupon) * fit.throw_mm / coupon.throw_mm,
        blur_mm=fit.blur_mm,
    )


def _notes(fit: FinishFit, placed: Placed, finished: Half, job: ResolvedJob) -> Iterator[CouponFinding]:
    if finished == "right":
        yield CouponFinding("right_finished")
    if placed.registration.mirrored:
        yield CouponFinding("mirrored")
    nominal = job.spec.optics.throw_mm
    off = fit.throw_mm - nominal
    if abs(off) > max(_WALL_OFF * nominal, 2 * fit.throw_error_mm):
        yield CouponFinding("wall_off", {"off_mm": off, "throw_mm": fit.throw_mm, "nominal_mm": nominal})
    finish = Finish(k0_rad_per_mm=fit.k0_rad_per_mm, order=fit.order)
    waves = [one.k_rad_per_mm for one in fit.ripples]
    if float(finish.transfer(np.array(max(waves)))) > 0.7 or fit.k0_rad_per_mm > 0.9 * K0_RANGE[1]:
        yield CouponFinding("too_light", {"least": 2 * max(waves)})
    if float(finish.transfer(np.array(min(waves)))) < 0.3:
        yield CouponFinding("too_strong", {"most": min(waves)})
    if lost := 8 - len(fit.ripples):
        yield CouponFinding("short_lost", {"count": lost})
    if fit.misfit > 2.5:
        yield CouponFinding("poor_fit", {"misfit": fit.misfit})


def snippet(result: CouponResult) -> str:
    """Return figures ready for a job's spec."""
    lines, table = ["# measured on a test piece"], ""
    for key, value in result.values().items():
        before, table = table, key.partition(".")[0]
        lines += [f"[{table}]"] if table != before else []
        lines.append(f"{key.partition('.')[2]} = {json.dumps(value)}")
    return "\n".join(lines) + "\n"


def print_findings(result: CouponResult) -> Iterator[str]:
    """Yield what the command prints."""
    fit, rows = result.fit, result.rows
    yield (
        f"finish: k0 {fit.k0_rad_per_mm:.2f} rad/mm ({fit.k0_range[0]:.2f} to {fit.k0_range[1]:.2f}), "
        f"order {fit.order:.2f} ({fit.order_range[0]:.2f} to {fit.order_range[1]:.2f})"
    )
    half = 2 * math.pi / (fit.k0_rad_per_mm * math.log(2.0) ** (1 / fit.order))
    yield f"        half of a wave of {half:.2g} mm is left"
    most = f" to {1000 * rows.high_mm:.2g}" if math.isfinite(rows.high_mm) else " or more"
    yield (
        f"mill: rows off by {1000 * rows.z_noise_mm:.2g} um ({1000 * rows.low_mm:.2g}{most}), "
        f"ripples {fit.mill_gain:.2f} times as high as programmed"
    )
    yield f"wall: {fit.throw_mm:.1f} mm from Z0 (+-{fit.throw_error_mm:.1f}); blur {fit.blur_mm:.3f} mm"
    yield "left of each ripple, by period:"
    for one in fit.ripples:
        yield f"  {one.period_mm:5.2f} mm: {100 * one.share:5.1f} % (+-{100 * one.error:.1f})"
    for note in result.notes:
        yield f"note: {note.sentence()}"
