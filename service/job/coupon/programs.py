"""Makes the folder of a test piece from its spec: programs, checked like those of a job, and the predicted photograph.
A server keeps one for each machine, made at the first request.
"""

from __future__ import annotations

import hashlib
import io
import shutil
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cam.as_milled.rows import tip_error_mm
from cam.as_milled.surface import MilledSurface, mill_heights
from cam.as_milled.tracks import Noise, Tracks
from cam.passes import PassSpec
from cam.reading.gcode import LANGUAGES, read_parts
from cam.surface.stock_grid import StockGrid
from optics.coupon.fringes import Complex, Profile, Transfer, profiles_of_heights
from optics.coupon.halves import AROUND_MM, finish_heights, light_of_facets, light_of_heights, screen_axes_mm
from optics.coupon.layout import HEIGHT_MM, WIDTH_MM, Coupon, window_mm
from optics.heightfield import Array
from optics.irradiance import picture_from_irradiance
from service.job import arrays
from service.job import files as job_files
from service.job.coupon.piece import (
    PREDICTED,
    PREDICTED_FINISHED,
    PROFILES,
    SHEET,
    coupon_job,
    coupon_of,
    list_finish_programs,
    sheet_lines,
)
from service.job.picture.light_png import picture_png
from service.job.pipeline import FolderJob
from service.job.spec.finish import FinishSpec
from service.job.spec.lens_task import finish_of
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob, cam_passes_of
from service.job.stages.context import PictureQueue, peak_rss_mb, versions
from service.job.stages.order import merge_reports
from service.job.stages.table import JobSoFar
from service.progress import Reporter, Stopwatch, report_progress

PIXELS_PER_MM = 20
TEMPLATES_RAD_PER_MM = (6.0, 3.0, 12.0, 25.0)
"""k0 of finishes of order 2 for which the light is predicted; a photograph is registered with the most similar one."""

CELL_MM, FINE_CELL_MM = 0.02, 0.01
_BEYOND_MM = 0.9  # width of the heights around the piece, all within the area of the ball
_SEEDS = (2, 1)  # seeds of the mill's errors: for the comparison with photographs, and for the pictures
_ABOVE_MM = 0.03  # of the stock before the finish, over the highest point
_NOT_SENT = {job_files.COUPON_ARCHIVE, job_files.HEIGHTFIELD}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Milled:
    """The result of the finishing program: tracks of its ball, and heights (ny, nx) on a grid around the piece."""

    coupon: Coupon
    passed: PassSpec
    tracks: Tracks
    x_mm: Array
    y_mm: Array
    z_mm: Array


def make_coupon(output: Path, job: ResolvedJob, *, reporter: Reporter, force: bool = False) -> dict[str, Any]:
    """Write the folder of a test piece; return the contents of report.json."""
    job_files.require_usable_output(output, force=force)
    spec, coupon = job.spec, coupon_of(job)
    with job_files.stage_folder(output) as folder, PictureQueue() as queue:
        plain_cuts = job.with_spec(spec.model_copy(update={"finish": FinishSpec()}))  # one half stays as it is milled
        so_far = JobSoFar(plain_cuts)
        piece = FolderJob(so_far, folder, reporter, queue)
        piece.desk[job_files.HEIGHTFIELD] = lens = coupon.heightfield()
        job_files.write_bytes(folder / job_files.HEIGHTFIELD, arrays.heightfield_bytes(lens))
        for number in range(1, len(spec.passes) + 1):
            piece.run(f"pass-{number}")
        so_far.notes.clear()  # notes on coarse steps and pictures; here the steps are taken into account
        piece.run("check")
        watch = Stopwatch(reporter)
        job_files.write_json(folder / job_files.REPORT, so_far.report)  # names the programs
        _write_predictions(folder, job, watch)
        part = {
            "warnings": [sentence for sentences in so_far.notes.values() for sentence in sentences],
            "timings_s": watch.timings_s,
            "peak_rss_mb": peak_rss_mb(),
            "versions": versions(),
        }
        report = merge_reports((so_far.report, part))
        job_files.write_bytes(folder / SHEET, ("\n".join(sheet_lines(job, report)) + "\n").encode())
        job_files.write_json(folder / job_files.SPEC, spec.plain())
        queue.finish()
        job_files.write_json(folder / job_files.REPORT, report)
    return report


def _write_predictions(folder: Path, job: ResolvedJob, watch: Stopwatch) -> None:
    """Write both pictures, and coupon.npz for the comparison with photographs."""
    with watch.stage("heights as milled") as on_progress:
        profiles = profiles_of_milled(mill_piece(folder, job, seed=_SEEDS[0], cell_mm=FINE_CELL_MM))
        on_progress(0.5)
        made, clean = mill_piece(folder, job, seed=_SEEDS[1]), mill_piece(folder, job, seed=None)
    with watch.stage("predict photograph") as on_progress:
        finish = finish_of(job.spec)
        finishes = [_usual(k0) for k0 in TEMPLATES_RAD_PER_MM]
        light = predict_light(
            job, made, (None, None if finish is None else finish.compute_kept, *finishes), on_progress=on_progress
        )
        without_errors = predict_light(job, clean, (finishes[0],))[0]
    for name, one in zip((PREDICTED, PREDICTED_FINISHED), light, strict=False):
        _draw(folder / name, one, job.spec)
    values = {f"strip_{n}": _as_reals(profile.harmonics_mm) for n, profile in enumerate(profiles)}
    values |= {f"milled_{n}": _as_reals(profile.milled) for n, profile in enumerate(profiles)}
    values |= {f"light_{n}": _halve(one) for n, one in enumerate(light[2:])}
    x, y = screen_axes_mm(_pixels(PIXELS_PER_MM))
    begin, end = window_mm("right")
    values["across"] = np.array([y, without_errors[:, (x >= begin) & (x < end)].mean(axis=1)])
    job_files.write_bytes(folder / PROFILES, arrays.npz_bytes(values))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedPiece:
    """The prediction with which a photograph is compared.

    templates  : light (ny, nx) on the screen behind finishes of TEMPLATES_RAD_PER_MM, by which it is found
    across     : (2, ny) y, and the mean light of the half as milled there, without errors of rows
    """

    profiles: tuple[Profile, ...]
    templates: tuple[Array, ...]
    across: Array


def load_predicted_piece(path: Path, coupon: Coupon) -> PredictedPiece:
    """Load coupon.npz; InputError if the file is not one."""
    strips = [strip for strip in coupon.strips if strip.cycles]
    names = [f"{kind}_{number}" for kind in ("strip", "milled") for number in range(len(strips))]
    lights = [f"light_{number}" for number in range(len(TEMPLATES_RAD_PER_MM))]
    stored = arrays.load_arrays(path, (*names, *lights, "across"))
    profiles = tuple(
        Profile(
            strip=strip,
            harmonics_mm=_from_reals(stored[f"strip_{number}"]),
            milled=_from_reals(stored[f"milled_{number}"]),
        )
        for number, strip in enumerate(strips)
    )
    return PredictedPiece(profiles=profiles, templates=tuple(stored[name] for name in lights), across=stored["across"])


def _usual(k0_rad_per_mm: float) -> Transfer:
    return lambda k: np.asarray(np.exp(-((k / k0_rad_per_mm) ** 2)))


def _halve(light: Array) -> Array:
    """Return the picture at half the resolution."""
    ny, nx = light.shape
    return np.asarray(light.reshape(ny // 2, 2, nx // 2, 2).mean(axis=(1, 3)))


def mill_piece(folder: Path, job: ResolvedJob, *, seed: int | None = 1, cell_mm: float = CELL_MM) -> Milled:
    """Cut the piece's programs with the mill of the job; seed None: with one without errors."""
    spec, machine, coupon = job.spec, job.machine, coupon_of(job)
    passed = cam_passes_of(spec)[-1]
    noise = None if seed is None else Noise.of_pass(passed, machine.z_noise_mm, seed=seed)
    paths = list_finish_programs(folder, spec)
    tracks = Tracks.of_program(
        read_parts(map(job_files.read_chunks, paths), LANGUAGES[machine.dialect]),
        radius_mm=passed.radius_mm,
        step_mm=machine.step_mm,
        noise=noise,
    )
    around = round(_BEYOND_MM / cell_mm)
    nx, ny = (round(side / cell_mm) + 1 + 2 * around for side in (WIDTH_MM, HEIGHT_MM))
    corner = -around * cell_mm - cell_mm / 2
    top = np.full((ny, nx), -spec.stock.skim_mm + _ABOVE_MM)
    left = mill_heights([tracks], StockGrid(x0_mm=corner, y0_mm=corner, cell_mm=cell_mm, top_mm=top))
    return Milled(coupon=coupon, passed=passed, tracks=tracks, x_mm=left.x_mm, y_mm=left.y_mm, z_mm=left.top_mm)


def profiles_of_milled(milled: Milled) -> tuple[Profile, ...]:
    return profiles_of_heights(milled.coupon, milled.x_mm, milled.y_mm, milled.z_mm)


def predict_light(
    job: ResolvedJob,
    milled: Milled,
    finishes: Sequence[Transfer | None],
    *,
    throw_mm: float | None = None,
    pixels_per_mm: float = PIXELS_PER_MM,
    on_progress: Callable[[float], None] | None = None,
) -> list[Array]:
    """Predict irradiance (ny, nx) on the wall for each finish of the left half (None: as milled); 1 goes straight.

    throw_mm : of the wall, where it is not that of the job
    """
    spec, machine = job.spec, job.machine
    bench: dict[str, Any] = {
        "throw_mm": spec.optics.throw_mm if throw_mm is None else throw_mm,
        "refractive_index": spec.optics.refractive_index,
        "pixels": _pixels(pixels_per_mm),
    }
    facets = MilledSurface.of_tracks(
        [milled.tracks],
        milled.coupon.heightfield(0.1),
        pitch_mm=milled.passed.pitch_mm,
        error_mm=tip_error_mm(step_mm=machine.step_mm, z_noise_mm=machine.z_noise_mm),
    )
    part = cache(facets.part)  # some 60 MB in all, for either half
    right = light_of_facets(part, facets.parts, "right", on_progress=on_progress, **bench)
    out = []
    for transfer in finishes:
        if transfer is None:
            left = light_of_facets(part, facets.parts, "left", **bench)
        else:
            heights = finish_heights(milled.z_mm, milled.x_mm[1] - milled.x_mm[0], transfer)
            left = light_of_heights(milled.x_mm, milled.y_mm, heights, "left", **bench)
        out.append(left + right)
    return out


def _pixels(per_mm: float) -> tuple[int, int]:
    return round((HEIGHT_MM + 2 * AROUND_MM) * per_mm), round((WIDTH_MM + 2 * AROUND_MM) * per_mm)


def _draw(path: Path, light: Array, spec: JobSpec) -> None:
    seen = picture_from_irradiance(light, viewed_from=spec.optics.viewed_from)
    job_files.write_bytes(path, picture_png(seen, white=3.0))


def _as_reals(values: Complex) -> Array:
    return np.array([values.real, values.imag])


def _from_reals(rows: Array) -> Complex:
    return np.asarray(rows[0] + 1j * rows[1])


def keep_coupon(folder: Path, machine: str) -> Path:
    """Return the machine's test piece in a folder of test pieces, with an archive of it; make it if there is none.

    A newer version of this program keeps it, because it may have been milled. One made for an older profile is
    replaced. SpecError if there is no such machine.
    """
    job = coupon_job(machine=machine, throw_mm=None, file=None, overrides=())
    facts = repr((job.spec.plain(), asdict(job.machine), coupon_of(job)))
    piece = folder / machine / hashlib.sha256(facts.encode()).hexdigest()[:16]
    if not (piece / job_files.COUPON_ARCHIVE).is_file():
        piece.parent.mkdir(parents=True, exist_ok=True)
        with report_progress(quiet=True) as reporter:
            make_coupon(piece, job, reporter=reporter)
        job_files.write_bytes(piece / job_files.COUPON_ARCHIVE, _pack(piece))
        for older in piece.parent.glob("[!.]*"):  # a hidden one is being made
            if older != piece:
                shutil.rmtree(older, ignore_errors=True)
    return piece


def _pack(piece: Path) -> bytes:
    """Pack everything needed to mill the piece and to measure its photograph elsewhere."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(piece.iterdir()):
            if path.name not in _NOT_SENT:
                archive.writestr(job_files.zip_entry(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)
    return held.getvalue()
