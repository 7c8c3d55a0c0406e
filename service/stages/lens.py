"""Stages from the picture to the lens: each loads, calls the pure code and stores.

Drawing and the solid are imported where they are used: a worker that has just started can begin without them.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite

from optics.bench import Bench
from optics.design import LensDesign, design_lens
from optics.heightfield import Heightfield
from optics.irradiance import picture_from_irradiance, target_irradiance
from optics.settings import LensSettings
from service.job_files import HEIGHTFIELD, MAP, SOLID
from service.lens_facts import LensFacts, measure_lens
from service.picture import read_picture
from service.spec import MIN_FLOOR_MM, JobSpec
from service.stages import arrays
from service.stages.workshop import THE_PICTURE, Workshop

PICTURE, TARGET, HEIGHTS = ".picture.npz", ".target.npz", ".heights.npz"


def lens_settings(spec: JobSpec) -> LensSettings:
    """The optical task of a job."""
    optics = spec.optics
    bench = Bench.centred(
        width_mm=optics.width_mm,
        height_mm=optics.height_mm,
        throw_mm=optics.throw_mm,
        refractive_index=optics.refractive_index,
        screen_mm=optics.screen_size_mm,
    )
    return LensSettings(
        bench=bench,
        skim_mm=spec.stock.skim_mm,
        method=optics.method,
        corrections=optics.corrections,
        min_radius_mm=optics.min_radius_mm,
    )


def image(shop: Workshop) -> None:
    """Picture file -> linear light (ny, nx) at the job's pixel count, row 0 on top."""
    width_mm, height_mm = shop.spec.optics.screen_size_mm
    with shop.watch.stage("picture"):
        picture = read_picture(
            shop.picture,
            shop.spec.image,
            rows=shop.spec.pixel_rows,
            aspect=width_mm / height_mm,
            limits=shop.limits,
            name=shop.picture_called,
        )
        shop.hand_over(PICTURE, picture.linear, arrays.picture_bytes)
    for sentence in picture.warnings:
        shop.note("optics", f"{THE_PICTURE} {sentence}")
    shop.report["source"] = {"width": picture.width, "height": picture.height, "mode": picture.mode}


def irradiance(shop: Workshop) -> None:
    """Linear light -> target irradiance (ny, nx) in the work frame; target.png."""
    from service import figures

    linear = shop.receive(PICTURE, arrays.load_picture)
    viewed_from = shop.spec.optics.viewed_from
    with shop.watch.stage("target"):
        target = target_irradiance(linear, viewed_from=viewed_from)
        shop.hand_over(TARGET, target, arrays.target_bytes)
        seen = picture_from_irradiance(target, viewed_from=viewed_from)
        shop.save("target.png", figures.picture_png(seen, white=float(target.max())))


def transport_map(shop: Workshop) -> None:
    """Target -> map.npz and the lens's heights; what the design says of itself in report `optics`; flow.png."""
    target = shop.receive(TARGET, arrays.load_target)
    with shop.watch.stage("lens") as reached:
        design = design_lens(target, lens_settings(shop.spec), on_progress=_way(shop.spec, reached))
        way = {"screen_mm": design.transport_map.screen_mm, "lens_mm": design.transport_map.lens_mm}
        shop.hand_over(MAP, target, lambda target: arrays.npz_bytes({**way, "target": target}))
        shop.hand_over(HEIGHTS, design.heightfield, arrays.heightfield_bytes)
    _tell_of_design(shop, design)
    if design.flow is not None:
        from service import figures_lens

        picture = figures_lens.flow_png(design.flow.snapshots, viewed_from=shop.spec.optics.viewed_from)
        shop.save("flow.png", picture)


def heightfield(shop: Workshop) -> None:
    """Heights -> heightfield.npz, what can be measured on it (report `optics`), and the solid block it lies in."""
    lens = shop.receive(HEIGHTS, arrays.load_heightfield)
    with shop.watch.stage("facts"):
        shop.report["optics"] = _facts(measure_lens(lens))
        shop.hand_over(HEIGHTFIELD, lens, arrays.heightfield_bytes)
    solid_block(shop, lens)


def solid_block(shop: Workshop, lens: Heightfield) -> None:
    """lens.stl and lens.png: for looking at, never for CAM. ReliefTooDeep where too little of the block is left."""
    from service import figures_lens, solid

    stock = shop.spec.stock
    with shop.watch.stage("solid"):
        mesh = solid.lens_solid(
            lens, thickness_mm=stock.thickness_mm, margin_mm=stock.margin_mm, min_floor_mm=MIN_FLOOR_MM
        )
        shop.save(SOLID, solid.stl_bytes(mesh))
        shop.save("lens.png", figures_lens.heightfield_png(lens.x_mm, lens.y_mm, lens.z_mm))


def require_fit_in_stock(shop: Workshop, lens: Heightfield) -> None:
    """ReliefTooDeep unless enough of the block is left under the deepest point."""
    from service import solid

    solid.require_floor(lens, thickness_mm=shop.spec.stock.thickness_mm, min_floor_mm=MIN_FLOOR_MM)


def _way(spec: JobSpec, reached: Callable[[float], None]) -> Callable[[str, float], None]:
    """The phases of a design, each of which goes from 0 to 1, as one way from 0 to 1: by the time they take."""
    first = 1.0 / (1.0 + 0.8 * spec.optics.corrections)
    ways = {"transport map": (0.0, first), "corrections": (first, 1.0), "flow": (0.0, 0.9), "surface": (0.9, 1.0)}

    def tell(phase: str, share: float) -> None:
        begin, end = ways[phase]
        reached(begin + (end - begin) * share)

    return tell


def _tell_of_design(shop: Workshop, design: LensDesign) -> None:
    shop.report["optics"] = {
        "method": shop.spec.optics.method,
        "converged": design.converged,
        "message": design.message,
        "history": design.history,
    }
    if not design.converged:
        shop.note("optics", f"the lens design has not converged: {design.message}")


def _facts(facts: LensFacts) -> dict[str, float | None]:
    """Facts for report.json; null stands for 'nothing is concave, every ball fits'."""
    return {
        "relief_mm": facts.relief_mm,
        "max_slope_deg": facts.max_slope_deg,
        "min_concave_radius_mm": _finite(facts.min_concave_radius_mm),
        "concave_radius_99_mm": _finite(facts.radius_for_99_mm),
        "concave_radius_999_mm": _finite(facts.radius_for_999_mm),
    }


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
