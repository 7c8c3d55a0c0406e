"""The stage that simulates light through the surface that the programs really leave: the picture that the person will
get.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from cam.as_milled.rows import find_touched_surface, sample_facets, tip_error_mm
from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Noise, Screws, Tracks
from cam.passes import PassSpec
from cam.reading.gcode import LANGUAGES, read_parts
from machines.profile import MachineProfile
from optics.caustic import Caustic, simulate_caustic
from optics.finish import surface_in_light
from optics.heightfield import Array, Heightfield
from optics.irradiance import picture_from_irradiance
from optics.metrics import blurred_psnr_db, psnr_db, score_caustic, seen_db, smallest_detail_mm
from optics.milled import simulate_milled
from optics.milled_blur import Deviations, deviations, predict_light
from service.job import arrays
from service.job.files import HEIGHTFIELD, LIGHT_AS_MILLED, MAP, THUMBNAIL_AS_MILLED, names_of_pass, plain, read_chunks
from service.job.picture.light_png import picture_png, thumbnail_png
from service.job.planning.preparation import scores_against_original
from service.job.report.milled import detail_lost
from service.job.spec.lens_task import bench_of, facts_of_light, finish_of
from service.job.spec.resolve import cam_passes_of, post_of
from service.job.stages.context import StageContext
from service.job.stages.light import save_light

_SAMPLES, _FEW = 24, 4  # parts of the surface whose slopes are measured; a quarter for a small one, but at least _FEW
_SLOPES = 96  # number of slopes for the operator page
_FINER = 4.0  # a quarter of the pitch: almost without grooves


def run_as_milled(context: StageContext) -> None:
    """Simulate light through the surface that finishing programs leave: report `as_milled`, caustic-as-milled.png, and
    as-milled.png, which shows it beside target and design, and light-as-milled.bin for the operator page. Does nothing
    if no pass finishes.
    """
    heightfield = context.receive(HEIGHTFIELD, arrays.load_heightfield)
    target = context.receive(MAP, arrays.load_target)
    passes = list_finish_passes(context)
    if not passes:
        return
    bench, shape = bench_of(context.spec), (target.shape[0], target.shape[1])
    with context.watch.stage("as milled: surface") as on_progress:
        surface = MilledSurface.of_tracks(
            read_tracks(context, passes, on_progress),
            heightfield,
            pitch_mm=max(spec.pitch_mm for _, spec in passes),
            error_mm=error_of_tips_mm(context.machine),
            step_mm=context.machine.step_mm,
        )
    with context.watch.stage("as milled: light") as on_progress:
        part, sampled = _keep_samples(surface)
        seen = simulate_milled(part, surface.parts, heightfield, bench, pixels=shape, on_progress=on_progress)
        found = deviations((sampled.pop(n) for n in sorted(sampled)), heightfield, bench, shape, slopes=_SLOPES)
        if context.is_shown:
            save_light(context, LIGHT_AS_MILLED, heightfield, target, slopes=found.slopes)
    del surface, part
    with context.watch.stage("as milled: causes") as on_progress:
        designed = simulate_caustic(surface_in_light(heightfield, finish_of(context.spec)), bench, pixels=shape)
        # A finish removes the marks, so the gain without each of them is of no use as advice.
        finishes = context.spec.finish.finishes
        gains = {} if finishes else _gains(context, passes[0][1], heightfield, target, designed, on_progress)
    _report_milled(context, target, seen, designed, found, gains)
    _draw(context, target, designed.irradiance, seen.irradiance)


def list_finish_passes(context: StageContext) -> list[tuple[int, PassSpec]]:
    """List the passes that make the optical surface, with their numbers from 0."""
    return [(number, spec) for number, spec in enumerate(cam_passes_of(context.spec)) if spec.finishes]


def read_tracks(
    context: StageContext,
    passes: list[tuple[int, PassSpec]],
    on_progress: Callable[[float], None],
    *,
    longest_mm: float = math.inf,
) -> list[Tracks]:
    """Return the written programs of these passes as the mill runs them, with its steps and errors.

    longest_mm : greatest distance between stops of an axis on a step, also within moves
    """
    machine, rows = context.machine, context.so_far["passes"]
    screws, chord_mm = screws_of(machine), longest_mm if machine.step_mm > 0 else math.inf
    if screws is not None:
        chord_mm = min(chord_mm, screws.longest_mm)
    tracks = []
    for done, (number, spec) in enumerate(passes, 1):
        paths = [context.folder / name for name in names_of_pass(rows[number])]
        batches = read_parts(map(read_chunks, paths), LANGUAGES[machine.dialect])
        noise = Noise.of_pass(spec, machine.z_noise_mm, seed=number)
        one = Tracks.of_program(batches, radius_mm=spec.radius_mm)
        one = one.divide(chord_mm) if math.isfinite(chord_mm) else one
        tracks.append(one.run_on_mill(step_mm=machine.step_mm, noise=noise, screws=screws))
        on_progress(0.8 * done / len(passes))
    return tracks


def screws_of(machine: MachineProfile) -> Screws | None:
    """Return the errors of a mill's screws; None if it has none, or they are not known."""
    if machine.screw_error_mm is None or not any(machine.screw_error_mm):
        return None
    return Screws(error_mm=machine.screw_error_mm, lead_mm=machine.screw_lead_mm)


def error_of_tips_mm(machine: MachineProfile) -> float:
    """Return the standard deviation of the tips' heights on a mill: its steps, its noise, its dialect's decimals."""
    return tip_error_mm(step_mm=machine.step_mm, z_noise_mm=machine.z_noise_mm, decimals=_decimals(machine))


def _decimals(machine: MachineProfile) -> int:
    return round(-math.log10(post_of(machine).digits.z_mm))


def _keep_samples(surface: MilledSurface) -> tuple[Callable[[int], Array], dict[int, Array]]:
    """Return the surface's parts by number, and a store for the sampled parts once they are made."""
    samples = min(_SAMPLES, max(_FEW, surface.parts // 4))
    wanted = set(((np.arange(samples) + 0.5) / samples * surface.parts).astype(int).tolist())
    kept: dict[int, Array] = {}

    def part(number: int) -> Array:
        facets = surface.part(number)
        if number in wanted:
            kept[number] = facets
        return facets

    return part, kept


def _gains(
    context: StageContext,
    spec: PassSpec,
    heightfield: Heightfield,
    target: Array,
    designed: Caustic,
    on_progress: Callable[[float], None],
) -> dict[str, float]:
    """Return the gain in dB of the picture without each single cause, from samples of rows."""
    machine, bench = context.machine, bench_of(context.spec)
    now: dict[str, Any] = {
        "pitch_mm": spec.pitch_mm,
        "step_mm": machine.step_mm,
        "z_noise_mm": machine.z_noise_mm,
        "screws": screws_of(machine),
        "decimals": _decimals(machine),
        "surface": find_touched_surface(heightfield, spec.radius_mm, spec.direction),
    }
    without: dict[str, dict[str, Any]] = {
        "scallops": {"pitch_mm": max(spec.pitch_mm / _FINER, machine.step_mm)},  # closer rows would coincide
        "steps": {"step_mm": 0.0},
        "noise": {"z_noise_mm": 0.0},
        "rounding": {"decimals": 9},
    }
    if now["screws"] is not None:
        without["screws"] = {"screws": None}
    without[""] = {}
    scores = {}
    for cause, change in without.items():
        facets = sample_facets(heightfield, radius_mm=spec.radius_mm, direction=spec.direction, **{**now, **change})
        scores[cause] = psnr_db(predict_light(designed.irradiance, facets, heightfield, bench), target)
        on_progress(len(scores) / len(without))
    for cause, other in bench.without_each_flaw().items():
        seen = simulate_caustic(heightfield, other, pixels=(target.shape[0], target.shape[1]))
        scores[cause] = psnr_db(predict_light(seen.irradiance, facets, heightfield, other), target)
    own = scores.pop("")
    return {cause: score - own for cause, score in scores.items()}


def _report_milled(
    context: StageContext, target: Array, seen: Caustic, designed: Caustic, found: Deviations, gains: dict[str, float]
) -> None:
    machine, pixel_mm = context.machine, context.spec.optics.screen_size_mm[0] / target.shape[1]
    context.report["as_milled"] = plain(
        {
            **asdict(score_caustic(seen.irradiance, target)),
            **scores_against_original(context.folder / MAP, seen.irradiance),
            "smallest_detail_mm": smallest_detail_mm(seen.irradiance, target, pixel_mm),
            "psnr_db_designed": psnr_db(designed.irradiance, target),
            "seen_db_designed": seen_db(designed.irradiance, target),
            "light": facts_of_light(context.spec),
            "outside_share": seen.outside_share,
            "reflected_share": seen.reflected_share,
            "slope_rms_mrad": found.slope_mrad,
            "slope_x_rms_mrad": found.slope_x_mrad,
            "slope_y_rms_mrad": found.slope_y_mrad,
            "blur_px": found.blur_px,
            "blur_x_px": found.blur_x_px,
            "blur_y_px": found.blur_y_px,
            "psnr_db_blurred": blurred_psnr_db(target, (found.blur_y_px, found.blur_x_px)),
            "step_mm": machine.step_mm,
            "z_noise_mm": machine.z_noise_mm,
            "screw_error_mm": machine.screw_error_mm,
            "gain_db_without": gains,
        }
    )
    if context.spec.finish.finishes:  # which removes the marks
        return
    if lost := detail_lost(context.report["as_milled"], planned=context.spec.preset == "recommended"):
        context.note("passes", lost)


def _draw(context: StageContext, target: Array, designed: Array, milled: Array) -> None:
    from service.job.report.figures.wall import as_milled_png  # its dependencies are slow to import

    viewed_from = context.spec.optics.viewed_from
    views = [picture_from_irradiance(one, viewed_from=viewed_from) for one in (target, designed, milled)]
    white = float(target.max())
    figures = context.report["as_milled"]
    context.draw("caustic-as-milled.png", lambda: picture_png(views[2], white=white))
    if context.is_shown:
        context.draw(THUMBNAIL_AS_MILLED, lambda: thumbnail_png(views[2], white=white))
    context.draw("as-milled.png", lambda: as_milled_png(*views, figures=figures))
