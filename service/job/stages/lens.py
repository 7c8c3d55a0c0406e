"""The stages from the picture to the lens. Each loads its inputs, calls pure code, and stores the results.

Drawing and the solid are imported where they are used, so that a worker that has just started can begin without them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from itertools import accumulate
from typing import Any

from optics.black import dark_leak_estimate
from optics.design import LensDesign, design_lens
from optics.foreseen import sharpen
from optics.heightfield import Array, Heightfield
from optics.irradiance import picture_from_irradiance
from optics.lens_settings import LensSettings
from phrases.phrase import Phrase
from service.job import arrays
from service.job.files import HEIGHTFIELD, MAP, PREPARED, SOLID, SURFACE, TARGET_PICTURE, THUMBNAIL, plain
from service.job.page_data.surface import surface_bytes
from service.job.picture.light_png import picture_png, thumbnail_png
from service.job.picture.reading import read_picture
from service.job.planning.lens_facts import LensFacts, measure_lens
from service.job.planning.preparation import aim_at_picture
from service.job.spec.cutting import MIN_FLOOR_MM
from service.job.spec.lens_task import branch_of, facts_of_light, lens_settings, require_contrast
from service.job.spec.model import JobSpec
from service.job.stages.context import THE_PICTURE, StageContext

POLISH_SHARE = 12.0  # time of a polish, in units of the first solution
PICTURE, TARGET, ORIGINAL = ".picture.npz", ".target.npz", ".original.npz"
POLISHED, HEIGHTS = ".polished.npz", ".heights.npz"


def run_image(context: StageContext) -> None:
    """Convert the picture file to linear light (ny, nx) at the job's pixel count, row 0 on top."""
    width_mm, height_mm = context.spec.optics.screen_size_mm
    with context.watch.stage("picture"):
        picture = read_picture(
            context.picture,
            context.spec.image,
            rows=context.spec.pixel_rows,
            aspect=width_mm / height_mm,
            limits=context.limits,
            name=context.picture_called,
        )
        context.hand_over(PICTURE, picture.linear, arrays.picture_bytes)
    for sentence in picture.warnings:
        context.note("optics", Phrase("{picture} {sentence}", picture=THE_PICTURE, sentence=sentence))
    context.report["source"] = {"width": picture.width, "height": picture.height, "mode": picture.mode}


def run_irradiance(context: StageContext) -> None:
    """Convert linear light to target irradiance (ny, nx) in the work frame, prepared for the wall where that is asked
    for; target.png, and small for the operator page; prepared.png, report `image`.
    """
    linear = context.receive(PICTURE, arrays.load_picture)
    viewed_from = context.spec.optics.viewed_from
    with context.watch.stage("target"):
        aimed = aim_at_picture(context.spec, linear)
        target, original, detail_mm = aimed.target, aimed.original, aimed.detail_mm
        context.hand_over(TARGET, target, arrays.target_bytes)
        seen, white = picture_from_irradiance(target, viewed_from=viewed_from), float(target.max())
        context.draw(TARGET_PICTURE, lambda: picture_png(seen, white=white))
        if context.is_shown:
            context.draw(THUMBNAIL, lambda: thumbnail_png(seen, white=white))
        if original is not None:
            context.hand_over(ORIGINAL, original, arrays.target_bytes)
            given = picture_from_irradiance(original, viewed_from=viewed_from)
            context.draw(PREPARED, lambda: _draw_preparation(given, seen, detail_mm or 0.0))
    if figures := aimed.figures():
        context.report["image"] = plain(figures)


def _draw_preparation(given: Array, prepared: Array, detail_mm: float) -> bytes:
    from service.job.report.figures.wall import preparation_png

    return preparation_png(given, prepared, detail_mm=detail_mm)


def run_transport_map(context: StageContext) -> None:
    """Design the lens of the target, from the plan's polish if that was of the same lens: map.npz, with the picture as
    given where a prepared one is aimed at, and heights; the record of the design in report `optics`; flow.png.
    """
    target = context.receive(TARGET, arrays.load_target)
    require_contrast(context.spec, target)
    with context.watch.stage("lens") as on_progress:
        settings = lens_settings(context.spec, branch=branch_of(context.spec, target))
        design = design_lens(
            aim_of(context.spec, target),
            settings,
            on_progress=_way(context.spec, on_progress),
            polished=context.receive_if_there(POLISHED, arrays.load_polished),
        )
        way = {"screen_mm": design.transport_map.screen_mm, "lens_mm": design.transport_map.lens_mm}
        if (original := context.receive_if_there(ORIGINAL, arrays.load_target)) is not None:
            way["original"] = original
        context.hand_over(MAP, target, lambda target: arrays.npz_bytes({**way, "target": target}))
        context.hand_over(HEIGHTS, design.heightfield, arrays.heightfield_bytes)
    _report_design(context, design, target, settings)
    if design.flow is not None:
        from service.job.report.figures.lens import flow_png

        snapshots, viewed_from = design.flow.snapshots, context.spec.optics.viewed_from
        context.draw("flow.png", lambda: flow_png(snapshots, viewed_from=viewed_from))


def aim_of(spec: JobSpec, target: Array) -> Array:
    """Return the target, sharpened to compensate for the blur of milling."""
    (width_mm, height_mm), (ny, nx) = spec.optics.screen_size_mm, target.shape
    blur_x_mm, blur_y_mm = spec.optics.foreseen_blur_mm
    return sharpen(target, (blur_y_mm * ny / height_mm, blur_x_mm * nx / width_mm))


def run_heightfield(context: StageContext) -> None:
    """Write heightfield.npz, what can be measured on it (report `optics`), the solid block it lies in, and
    surface.bin for the operator page.
    """
    lens = context.receive(HEIGHTS, arrays.load_heightfield)
    with context.watch.stage("facts"):
        context.report["optics"] = _facts(measure_lens(lens))
        context.hand_over(HEIGHTFIELD, lens, arrays.heightfield_bytes)
        if context.is_shown:
            context.save(SURFACE, _surface(context.spec, lens))
    write_solid_block(context, lens)


def _surface(spec: JobSpec, lens: Heightfield) -> bytes:
    stock = spec.stock
    return surface_bytes(
        lens, thickness_mm=stock.thickness_mm, margin_mm=stock.margin_mm, outline_mm=spec.optics.outline_mm
    )


def write_solid_block(context: StageContext, lens: Heightfield) -> None:
    """Write lens.stl and lens.png, for viewing, never for CAM; the STEP file where it is asked for. ReliefTooDeep if
    too little of the block is left.
    """
    require_fit_in_stock(context, lens)
    context.draw(SOLID, lambda: _stl(context.spec, lens))
    context.draw("lens.png", lambda: _lens_png(context.spec, lens))
    if context.spec.stock.step_file:
        context.save(*_step(context.spec, lens))


def _stl(spec: JobSpec, lens: Heightfield) -> bytes:
    from service.job.report import solid

    return solid.stl_bytes(
        solid.lens_solid(
            lens,
            thickness_mm=spec.stock.thickness_mm,
            margin_mm=spec.stock.margin_mm,
            min_floor_mm=MIN_FLOOR_MM,
            outline_mm=spec.optics.outline_mm,
        )
    )


def _step(spec: JobSpec, lens: Heightfield) -> tuple[str, bytes]:
    from service.job.report import step

    return step.step_file(
        step.step_pieces(lens, thickness_mm=spec.stock.thickness_mm, outline=spec.optics.outline_or_shape)
    )


def _lens_png(spec: JobSpec, lens: Heightfield) -> bytes:
    from service.job.report.figures.lens import heightfield_png

    return heightfield_png(lens.x_mm, lens.y_mm, lens.z_mm, outline_mm=spec.optics.outline_mm)


def require_fit_in_stock(context: StageContext, lens: Heightfield) -> None:
    """Raise ReliefTooDeep unless enough of the block is left under the deepest point."""
    from service.job.report import solid

    solid.require_floor(lens, thickness_mm=context.spec.stock.thickness_mm, min_floor_mm=MIN_FLOOR_MM)


def _way(spec: JobSpec, on_progress: Callable[[float], None]) -> Callable[[str, float], None]:
    """Combine the phases of a design, each of which goes from 0 to 1, into one progress from 0 to 1, weighted by their
    times.
    """
    lengths = {"transport map": 1.0, "corrections": 0.8 * spec.optics.corrections, "polish": POLISH_SHARE}
    if spec.optics.method == "paper":
        lengths = {"flow": 0.9, "surface": 0.1}
    elif not (spec.optics.polish or spec.finish.finishes):
        del lengths["polish"]
    ends = dict(zip(lengths, accumulate(lengths.values()), strict=True))
    whole = sum(lengths.values())

    def report_share(phase: str, share: float) -> None:
        if phase in ends:
            on_progress((ends[phase] - (1.0 - share) * lengths[phase]) / whole)

    return report_share


def _report_design(context: StageContext, design: LensDesign, target: Array, settings: LensSettings) -> None:
    context.report["optics"] = {
        "light": facts_of_light(context.spec),
        "method": context.spec.optics.method,
        "surface": context.spec.optics.surface,
        "branch": settings.bench.branch,
        "min_radius_mm": settings.closing_radius_mm,
        "converged": design.converged,
        "message": design.message,
        "history": design.history,
        "dark_leak_estimate": dark_leak_estimate(target, settings.bench, settings.closing_radius_mm),
        "closing": None if design.closing is None else plain(asdict(design.closing)),
        "polish": None if design.polish is None else _without_clock(asdict(design.polish)),
    }
    if not design.converged:
        context.note("optics", Phrase("the lens design has not converged: {message}", message=design.message))
    for advice in design.warnings:
        context.note("optics", advice.sentence())


def _without_clock(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without its seconds: a stage must report the same values each time; `timings_s` holds
    durations.
    """
    return plain({key: value for key, value in record.items() if key != "seconds"})


def _facts(facts: LensFacts) -> dict[str, Any]:
    """Return facts for report.json; null stands for 'nothing is concave, every ball fits'."""
    return plain(
        {
            "relief_mm": facts.relief_mm,
            "max_slope_deg": facts.max_slope_deg,
            "min_concave_radius_mm": facts.min_concave_radius_mm,
            "concave_radius_99_mm": facts.radius_for_99_mm,
            "concave_radius_999_mm": facts.radius_for_999_mm,
            "concave_curvature_per_mm": facts.curvature_per_mm,
        }
    )
