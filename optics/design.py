"""Designs a lens for a target irradiance: map, surface, corrections against its own simulated caustic, polish."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from optics.ball_fit import fit_ball
from optics.black import Advice, find_advice
from optics.corrections import ClosingCost, Corrected, Pass, Progress, correct_lens, measure_closing_cost
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.polish import Polished, PolishRecord, digest_task, polish_lens
from optics.spline import Array
from optics.transport.solver import TOLERANCE, OpticalPath
from optics.transport_map import TransportMap
from phrases.phrase import Phrase

if TYPE_CHECKING:
    from optics.paper.flow import PaperFlow

_DEAR_DB = 3.0  # a closing that costs more is reported
_DEAR_LEAK = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensDesign:
    """A lens and a record of its design. If it is not `converged`, `message` says how far the design got; the lens is
    still usable.

    history  : a record of each pass of the method
    warnings : sentences for a person, each with what to change
    closing  : cost of filling valleys; None if there was nothing to fill
    polish   : result of the descent at the end; None if there was none
    """

    heightfield: Heightfield
    transport_map: TransportMap
    converged: bool
    history: list[dict[str, Any]]
    message: Phrase
    seconds: float
    flow: PaperFlow | None = None  # the steps of the paper's method, if that was used
    warnings: tuple[Advice, ...] = ()
    closing: ClosingCost | None = None
    polish: PolishRecord | None = None


def design_lens(
    target: Array,
    settings: LensSettings,
    *,
    on_progress: Progress | None = None,
    passes: Corrected | None = None,
    polished: Polished | None = None,
) -> LensDesign:
    """Return the lens for `target` (ny, nx), work frame, mean 1, by the chosen method.

    passes   : those of the transport method, if they are already computed
    polished : taken as it is if it was made for the same task
    """
    report = on_progress or (lambda stage, share: None)
    if settings.method == "transport":
        design = _design_by_transport(target, settings, report, passes, polished)
    else:
        design = _design_by_paper(target, settings, report)
    hard = find_advice(
        target, settings.bench, settings.closing_radius_mm, vertices_per_pixel=settings.vertices_per_pixel
    )
    return replace(design, warnings=(*hard, *design.warnings))


def _design_by_paper(target: Array, settings: LensSettings, report: Progress) -> LensDesign:
    from optics.paper.surface import paper_lens  # its dependencies are slow to import

    started = time.perf_counter()
    lens, ball_mm = paper_lens(target, settings, on_progress=report), settings.closing_radius_mm
    return LensDesign(
        heightfield=fit_ball(lens.heightfield, ball_mm) if ball_mm > 0 else lens.heightfield,
        transport_map=TransportMap(screen_mm=lens.screen_mm, lens_mm=lens.lens_mm),
        converged=lens.converged,
        history=lens.history(),
        message=lens.message,
        seconds=time.perf_counter() - started,
        flow=lens.flow,
    )


def _design_by_transport(
    target: Array, settings: LensSettings, report: Progress, passes: Corrected | None, polished: Polished | None
) -> LensDesign:
    started = time.perf_counter()
    done = passes or correct_lens(target, settings, report)
    cost = measure_closing_cost(done, target, settings)
    lens, polish = done.best.lens, None
    if steps := settings.descent_steps:
        report("polish", 0.0)
        task = partial(polish_lens, steps=steps, ball_mm=settings.closing_radius_mm, finish=settings.finish)
        if polished is None or polished.task != digest_task(lens, target, settings.bench, **task.keywords):
            lens, polish = task(lens, target, settings.bench, on_progress=lambda share: report("polish", share))
        else:
            lens, polish = replace(lens, z_mm=polished.z_mm), polished.record
    return LensDesign(
        heightfield=lens,
        transport_map=done.best.path.transport_map(),
        converged=done.best.converged,
        history=done.history,
        message=_message(done.best),
        seconds=time.perf_counter() - started,
        warnings=_warnings(cost),
        closing=cost,
        polish=polish,
    )


def _message(seen: Pass) -> Phrase:
    way = _describe_way(seen.path)
    if seen.converged:
        return Phrase("converged: {way}", way=way)
    if seen.loses_light and seen.path.bench.light.extended:
        return Phrase(
            "{percent:.0f} % of the light misses the screen: the source is large for this picture and screen, or the "
            "picture is finer than the lens can show (the map has {way})",
            percent=100 * seen.lost_share,
            way=way,
        )
    if seen.loses_light:
        return Phrase(
            "{percent:.0f} % of the light misses the screen: the picture is finer than the lens can show (the map has "
            "{way})",
            percent=100 * seen.lost_share,
            way=way,
        )
    return Phrase(
        "stopped: {way}, wanted {tolerance:g}; the lens is usable, its contrast may be lower than the picture's",
        way=way,
        tolerance=TOLERANCE,
    )


def _describe_way(path: OpticalPath) -> Phrase:
    last = path.levels[-1]
    way = Phrase(
        "rms {rms:.1e} of the mean irradiance after {count} steps at full size", rms=last.rms, count=last.iterations
    )
    if path.floor <= 0:
        return way
    if path.blur_pixels <= 0:
        return Phrase(
            "{way}, aimed at the picture with {floor_percent:g} % of even light, as without the surface would fold",
            way=way,
            floor_percent=100 * path.floor,
        )
    return Phrase(
        "{way}, aimed at the picture with {floor_percent:g} % of even light and blurred by {blur_px:g} pixels, as "
        "without the surface would fold",
        way=way,
        floor_percent=100 * path.floor,
        blur_px=path.blur_pixels,
    )


def _warnings(cost: ClosingCost | None) -> tuple[Advice, ...]:
    if cost is None:
        return ()
    lost_db, leak = cost.psnr_db_without - cost.psnr_db_with, cost.dark_leak_with - cost.dark_leak_without
    if lost_db < _DEAR_DB and leak < _DEAR_LEAK:
        return ()
    words = Phrase(
        "the picture will be flatter and its dark areas brighter, as the ball does not fit the lens's narrow valleys: "
        "a smaller ball, a wall farther away or a wider lens keeps more of it"
    )
    figures = Phrase(
        "ball of radius {radius_mm:g} mm, Ø {diameter_mm:g}: {lost_db:.1f} dB, {percent:.1f} % more of the light in "
        "dark areas",
        radius_mm=cost.radius_mm,
        diameter_mm=2 * cost.radius_mm,
        lost_db=lost_db,
        percent=100 * leak,
    )
    return (Advice(words, figures),)
