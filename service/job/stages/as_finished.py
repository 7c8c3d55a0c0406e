"""The stage that levels the milled surface as the finish will, and simulates light through it. The result is the
picture of the job. It also simulates too little and too much of the finish, and finds the tolerance in minutes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np

from cam.as_milled.height_map import DepartureMap, map_departure
from cam.materials import MATERIALS
from optics.bench import Bench
from optics.caustic import Caustic, simulate_caustic
from optics.finish import Finish, Finished, finish_lens
from optics.heightfield import Array, Heightfield
from optics.irradiance import picture_from_irradiance
from optics.metrics import psnr_db, score_caustic, smallest_detail_mm
from phrases.phrase import Phrase
from service.job import arrays
from service.job.files import (
    AS_FINISHED,
    COMPARED_FINISHED,
    FINISH_TOLERANCE,
    HEIGHTFIELD,
    LIGHT_AS_FINISHED,
    MAP,
    THUMBNAIL_AS_FINISHED,
    plain,
)
from service.job.picture.light_png import picture_png, row_png, thumbnail_png
from service.job.planning.preparation import scores_against_original
from service.job.planning.rim_room import advise_on_rims, measure_rim_room, warn_of_rim_room, weigh_removal
from service.job.spec.lens_task import bench_of, facts_of_light, finish_of
from service.job.spec.resolve import ResolvedJob, cam_passes_of
from service.job.stages.as_milled import error_of_tips_mm, list_finish_passes, read_tracks
from service.job.stages.context import StageContext
from service.job.stages.light import save_light

_STEPPING_MM = 0.05  # longest step within moves that a finish takes off; longer terraces stay
_COARSEST_MM, _CELLS_PER_WAVE = 0.05, 12  # cells of the height map: number of them for a wave of k0
_SEEN_MM = 0.1  # of a rim
_ALL_TOUCHED = 0.98  # of the lens: a loss on the rest is hardly visible
_TUBES_PER_PIXEL = 8  # along its side; but at least two a cell
K0_TIMES = (1.25, 0.8)
"""Of the planned k0: too little work, and too much."""

LOSS_DB = 1.0


def run_as_finished(context: StageContext) -> None:
    """Simulate light through the surface that programs and finish leave: report `as_finished` and `rim_room`,
    caustic-as-finished.png, comparison-as-finished.png, light-as-finished.bin for the operator page. Does nothing if
    nothing is finished by hand, or no pass finishes.
    """
    finish, passes = finish_of(context.spec), list_finish_passes(context)
    if finish is None or not passes:
        return
    lens = context.receive(HEIGHTFIELD, arrays.load_heightfield)
    target = context.receive(MAP, arrays.load_target)
    bench, shape = bench_of(context.spec), (target.shape[0], target.shape[1])
    with context.watch.stage("as finished: surface") as on_progress:
        tracks = read_tracks(context, passes, on_progress, longest_mm=_STEPPING_MM)
        departure = map_departure(
            tracks,
            lens,
            pitch_mm=max(spec.pitch_mm for _, spec in passes),
            error_mm=error_of_tips_mm(context.machine),
            finer=cells_per_vertex(lens, finish),
            beyond_mm=max(spec.radius_mm for _, spec in passes),
        )
        del tracks
        finished = finish_departure(lens, finish, departure)
    with context.watch.stage("as finished: light"):
        seen = light_through(finished.lens, bench, shape)
        if context.is_shown:
            save_light(context, LIGHT_AS_FINISHED, finished.lens, target)
        own_db, gains = psnr_db(seen.irradiance, target), {}
        for cause, other in bench.without_each_flaw().items():
            gains[cause] = psnr_db(light_through(finished.lens, other, shape).irradiance, target) - own_db
    _report_light(context, finished, target, seen, gains)
    _report_rims(context, lens, finish)
    if sentence := warn_of_lost_contact(finished.contact_share):
        context.note("passes", sentence)
    milled_mm = min(max(spec.radius_mm for _, spec in passes), context.spec.stock.margin_mm)
    if sentence := warn_of_rounded_rim(finish, milled_mm):
        context.note("passes", sentence)
    _draw(context, target, seen.irradiance)
    with context.watch.stage("as finished: tolerance"):
        report_tolerance(
            *(context, finish, target, seen.irradiance),
            lambda other: light_through(finish_departure(lens, other, departure).lens, bench, shape).irradiance,
        )


def warn_of_rounded_rim(finish: Finish, milled_mm: float) -> Phrase | None:
    """Warn if the milled border around the lens is narrower than the reach of the finish."""
    if (narrower_mm := finish.reach_mm - milled_mm) < _SEEN_MM:
        return None
    return Phrase(
        "the finish rounds everything within {reach_mm:.2g} mm of an edge, but only {milled_mm:g} mm are milled "
        "around the lens: its outermost {narrower_mm:.2g} mm may come out rounder than predicted; mask the rim, or "
        "use a larger ball",
        reach_mm=finish.reach_mm,
        milled_mm=milled_mm,
        narrower_mm=narrower_mm,
    )


def warn_of_lost_contact(share: float) -> Phrase | None:
    """Warn if the tool does not reach part of the lens; share, 0 to 1: of the lens that it touches."""
    if share >= _ALL_TOUCHED:
        return None
    return Phrase(
        "the tool of the finish touches {percent:.0f} % of the lens: its creases are too deep for it, nothing comes "
        "off there, and dark parts of the picture show bright lines. What helps: a wall farther away, which makes the "
        "creases shallower; a picture whose black is a dark grey; a finish that reaches creases, as lacquer does",
        percent=100 * share,
    )


def cells_per_vertex(lens: Heightfield, finish: Finish) -> int:
    """Return how many times finer than the lens's vertices the surface must be sampled for that finish."""
    cell_mm = min(_COARSEST_MM, 2.0 * math.pi / finish.k0_rad_per_mm / _CELLS_PER_WAVE)
    return math.ceil(max(lens.dx_mm, lens.dy_mm) / cell_mm)


def finish_departure(lens: Heightfield, finish: Finish, departure: DepartureMap) -> Finished:
    """Return the lens as milled and finished."""
    return finish_lens(
        lens,
        finish,
        departure_mm=departure.departure_mm,
        finer=departure.finer,
        beyond_cells=departure.beyond_cells,
    )


def light_through(finished: Heightfield, bench: Bench, shape: tuple[int, int]) -> Caustic:
    """Simulate light (ny, nx) through a surface that is sampled more finely than the picture."""
    pixel_mm = min(bench.screen.width_mm / shape[1], bench.screen.height_mm / shape[0])
    tubes = max(2, math.ceil(_TUBES_PER_PIXEL * finished.dx_mm / pixel_mm))
    return simulate_caustic(finished, bench, pixels=shape, tubes_per_cell=tubes)


def _report_light(
    context: StageContext, finished: Finished, target: Array, seen: Caustic, gains: dict[str, float]
) -> None:
    finish, score = finish_of(context.spec), asdict(score_caustic(seen.irradiance, target))
    assert finish is not None
    pixel_mm = bench_of(context.spec).screen.width_mm / target.shape[1]
    context.report["as_finished"] = plain(
        {
            **score,
            **scores_against_original(context.folder / MAP, seen.irradiance),
            "smallest_detail_mm": smallest_detail_mm(seen.irradiance, target, pixel_mm),
            "light": facts_of_light(context.spec),
            "outside_share": seen.outside_share,
            "reflected_share": seen.reflected_share,
            "contact_share": finished.contact_share,
            "gain_db_without": gains,
            "finish": {**context.spec.finish.model_dump(), "reach_mm": finish.reach_mm},
        }
    )


def _report_rims(context: StageContext, lens: Heightfield, finish: Finish) -> None:
    spec = context.spec
    room = measure_rim_room(lens, cam_passes_of(spec), finish, margin_mm=spec.stock.margin_mm)
    if room is None:
        return
    removed_g = weigh_removal(lens, finish, MATERIALS[spec.stock.material].density_g_per_cm3)
    context.report["rim_room"] = plain({**asdict(room), "advice": advise_on_rims(room), "removed_g": removed_g})
    if sentence := warn_of_rim_room(room):
        context.note("passes", sentence)


def _draw(context: StageContext, target: Array, finished: Array) -> None:
    from service.job.report.figures.wall import comparison_png  # its dependencies are slow to import

    viewed_from, white = context.spec.optics.viewed_from, float(target.max())
    aim, view = (picture_from_irradiance(one, viewed_from=viewed_from) for one in (target, finished))
    context.draw(AS_FINISHED, lambda: picture_png(view, white=white))
    if context.is_shown:
        context.draw(THUMBNAIL_AS_FINISHED, lambda: thumbnail_png(view, white=white))
    context.draw(COMPARED_FINISHED, lambda: comparison_png(aim, view, title="As finished"))


def report_tolerance(
    context: StageContext, finish: Finish, target: Array, planned: Array, light_of: Callable[[Finish], Array]
) -> None:
    """Report `finish_tolerance` and draw the light after too little of the finish, as planned, and after too much.

    planned  : irradiance (ny, nx) as finished; light_of: the same behind another finish
    """
    ratios = [minutes_ratio(context.job, finish, times) for times in K0_TIMES]
    lights = [light_of(work_longer(finish, times, ratio)) for times, ratio in zip(K0_TIMES, ratios, strict=True)]
    little, much = (float(score_caustic(light, target).psnr_db) for light in lights)
    usual = float(score_caustic(planned, target).psnr_db)
    context.report["finish_tolerance"] = {
        "light": facts_of_light(context.spec),
        "k0_times": list(K0_TIMES),
        "minutes_ratio": ratios,
        "psnr_db": [little, usual, much],
        "loss_db": LOSS_DB,
        "within_ratio": [
            find_limit(usual - loss_from, ratio) for loss_from, ratio in zip((little, much), ratios, strict=True)
        ],
    }
    viewed_from, white = context.spec.optics.viewed_from, float(target.max())
    views = [picture_from_irradiance(one, viewed_from=viewed_from) for one in (lights[0], planned, lights[1])]
    context.draw(FINISH_TOLERANCE, lambda: row_png(views, white=white))


def minutes_ratio(job: ResolvedJob, finish: Finish, k0_times: float) -> float:
    """Return the ratio to the planned minutes that gives this ratio to the planned k0."""
    process = job.figures.processes.get(job.spec.finish.process)
    exponent = 1 / finish.order if process is None else process.k0_exponent
    return float(k0_times ** (-1 / exponent))


def work_longer(finish: Finish, k0_times: float, minutes_times: float) -> Finish:
    """Return the finish after another time at the same pressure: the removal grows with the minutes."""
    depth_mm = None if finish.depth_mm is None else finish.depth_mm * minutes_times
    return replace(finish, k0_rad_per_mm=finish.k0_rad_per_mm * k0_times, depth_mm=depth_mm)


def find_limit(loss_db: float, ratio: float) -> float:
    """Return the ratio of minutes at which LOSS_DB is lost. The loss grows with the square of the ratio's logarithm and
    is loss_db at `ratio`; the result never lies beyond that, where nothing was simulated.
    """
    share = 1.0 if loss_db <= LOSS_DB else math.sqrt(LOSS_DB / loss_db)
    return float(np.exp(share * math.log(ratio)))
