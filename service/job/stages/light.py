"""The stage that simulates light through the lens: scores and pictures of the result."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from cam.materials import MATERIALS
from optics.bench import Bench
from optics.caustic import Caustic, simulate_caustic
from optics.finish import surface_in_light
from optics.heightfield import Array, Heightfield
from optics.irradiance import picture_from_irradiance
from optics.light import SUN_DEG
from optics.metrics import CausticScore, psnr_db, score_caustic
from optics.tolerance import (
    FOCUS_SHARES,
    SOURCES_DEG,
    TILTS_DEG,
    Tolerances,
    in_pixels,
    lens_tolerances,
    sharp_light,
)
from service.job import arrays
from service.job.files import HEIGHTFIELD, LIGHT, MAP, plain
from service.job.picture.light_png import picture_png
from service.job.planning.preparation import scores_against_original
from service.job.spec.lens_task import bench_of, explain_blocked_light, facts_of_light, finish_of, warn_of_reflection
from service.job.stages.context import StageContext

_BEAMS_OUT_OF_FOCUS = 7
THROUGH_FOCUS = (0.5, 1.0, 1.5, 2.0)  # of the throw, as the paper's Fig. 8


def run_caustic(context: StageContext) -> None:
    """Simulate the light of the perfect lens, after its finish if there is one: scores and tolerances into report
    `optics`; caustic.png, comparison.png, through-focus.png, and light.bin for the operator page.
    """
    heightfield = surface_in_light(context.receive(HEIGHTFIELD, arrays.load_heightfield), finish_of(context.spec))
    target = context.receive(MAP, arrays.load_target)
    bench = bench_of(context.spec)
    with context.watch.stage("caustic") as on_progress:
        sharp = sharp_light(heightfield, bench, _shape(target))
        without_size = replace(sharp, irradiance=in_pixels(sharp.irradiance))
        on_progress(0.2)
        in_focus = without_size
        if bench.light.extended:
            in_focus = simulate_caustic(heightfield, bench, pixels=_shape(target))
        on_progress(0.4)
        _report_caustic(context, in_focus, score_caustic(in_focus.irradiance, target))
        if len(bench.split_index(2)) > 1:
            plain_light = simulate_caustic(heightfield, bench.in_mean_colour(), pixels=_shape(target))
            context.report["optics"]["psnr_db_one_wavelength"] = psnr_db(plain_light.irradiance, target)
        if bench.light.extended:
            _report_without_size(context, score_caustic(without_size.irradiance, target))
        seen = [in_focus if factor == 1.0 else _at(factor, heightfield, bench, target) for factor in THROUGH_FOCUS]
        on_progress(0.7)
        _draw(context, target, seen)
        if context.is_shown:
            save_light(context, LIGHT, heightfield, target)
    with context.watch.stage("tolerances") as on_progress:
        found = lens_tolerances(
            heightfield,
            bench,
            target,
            sharp=sharp.irradiance,
            index_spread=MATERIALS[context.spec.stock.material].index_spread,
            on_progress=on_progress,
        )
        context.report["optics"]["tolerances"] = _figures(found)
        _draw_tolerances(context, target, found)


def _at(factor: float, heightfield: Heightfield, bench: Bench, target: Array) -> Caustic:
    """Return the light on a screen far out of focus, at that factor of the throw."""
    moved = replace(bench, throw_mm=factor * bench.throw_mm)
    return simulate_caustic(heightfield, moved, pixels=_shape(target), tubes_per_cell=1, beams=_BEAMS_OUT_OF_FOCUS)


def save_light(
    context: StageContext, name: str, surface: Heightfield, target: Array, *, slopes: Array | None = None
) -> None:
    """Save the surface with the light of the job for the operator page; slopes: by which it is off."""
    from service.job.page_data.surface import light_bytes  # its dependencies are slow to import

    bench, viewed_from = bench_of(context.spec), context.spec.optics.viewed_from
    context.save(name, light_bytes(surface, bench, white=float(target.max()), viewed_from=viewed_from, slopes=slopes))


def _shape(target: Array) -> tuple[int, int]:
    return target.shape[0], target.shape[1]


def _draw(context: StageContext, target: Array, seen: list[Caustic]) -> None:
    # its dependencies are slow to import
    from service.job.report.figures.wall import comparison_png, through_focus_png

    white = float(target.max())
    pictures = [_as_seen(context, one.irradiance) for one in seen]
    in_focus = pictures[THROUGH_FOCUS.index(1.0)]
    series = list(zip(THROUGH_FOCUS, pictures, strict=True))
    aim, throw_mm = _as_seen(context, target), context.spec.optics.throw_mm
    context.draw("caustic.png", lambda: picture_png(in_focus, white=white))
    context.draw("comparison.png", lambda: comparison_png(aim, in_focus))
    context.draw("through-focus.png", lambda: through_focus_png(series, throw_mm=throw_mm, white=white))


def _draw_tolerances(context: StageContext, target: Array, found: Tolerances) -> None:
    from service.job.report.figures.wall import tolerances_png

    middle = FOCUS_SHARES.index(0.0)
    before, after = FOCUS_SHARES.index(-0.01), FOCUS_SHARES.index(0.01)
    tilt, sun = found.tilts[TILTS_DEG.index(1.0)], found.sources[SOURCES_DEG.index(SUN_DEG)]
    shown = [
        (f"wall 1 % nearer, {found.focus[before].psnr_db:.1f} dB", found.focus[before].irradiance),
        (f"as designed, {found.psnr_db:.1f} dB", found.focus[middle].irradiance),
        (f"wall 1 % farther, {found.focus[after].psnr_db:.1f} dB", found.focus[after].irradiance),
        (f"light {tilt.tilt_deg:g}° aslant, {tilt.psnr_db:.1f} dB", tilt.irradiance),
        (f"source of {sun.size_deg:g}°, {sun.psnr_db:.1f} dB", sun.irradiance),
    ]
    pictures = [(caption, _as_seen(context, irradiance)) for caption, irradiance in shown]
    white = float(target.max())
    context.draw("tolerances.png", lambda: tolerances_png(found, pictures, white=white))


def _figures(found: Tolerances) -> dict[str, Any]:
    """Return the tolerances without their pictures."""
    return plain(
        {
            "psnr_db": found.psnr_db,
            "focus": [{"offset_mm": p.offset_mm, "psnr_db": p.psnr_db} for p in found.focus],
            "focus_range_mm": found.focus_range_mm,
            "tilts": [{"tilt_deg": p.tilt_deg, "shift_mm": p.shift_mm, "psnr_db": p.psnr_db} for p in found.tilts],
            "sources": [
                {key: getattr(p, key) for key in ("size_deg", "diameter_mm", "diameter_px", "psnr_db")}
                for p in found.sources
            ],
            "index": None if found.index is None else asdict(found.index),
            "blur_mm": found.blur_mm,
            "blur_px": found.blur_px,
        }
    )


def _report_caustic(context: StageContext, in_focus: Caustic, score: CausticScore) -> None:
    context.report["optics"] = plain(
        {
            **asdict(score),
            **scores_against_original(context.folder / MAP, in_focus.irradiance),
            "light": facts_of_light(context.spec),
            "outside_share": in_focus.outside_share,
            "reflected_share": in_focus.reflected_share,
        }
    )
    if in_focus.reflected_share > 1e-6 and context.spec.optics.surface == "lens":
        context.note("optics", warn_of_reflection(in_focus.reflected_share))
    if blocked := explain_blocked_light(context.spec):
        context.note("optics", blocked)


def _report_without_size(context: StageContext, score: CausticScore) -> None:
    """Report the quality of the lens itself if most of the loss comes from the size of the source."""
    context.report["optics"]["from_a_point_source"] = plain(asdict(score))


def _as_seen(context: StageContext, irradiance: Array) -> Array:
    return picture_from_irradiance(irradiance, viewed_from=context.spec.optics.viewed_from)
