"""Stages from the picture to the lens and the light behind it: each loads, calls the pure code and stores."""

from __future__ import annotations

from math import isfinite
from pathlib import Path

from optics.caustic import simulate_caustic
from optics.design import LensDesign, design_lens
from optics.heightfield import Array, Heightfield
from optics.irradiance import picture_from_irradiance, target_irradiance
from optics.metrics import score_caustic
from service import figures, figures_lens, solid
from service.lens_facts import LensFacts, measure_lens
from service.picture import read_picture
from service.spec import MIN_FLOOR_MM
from service.workshop import Workshop, lens_settings, save_heightfield, save_map

THROUGH_FOCUS = (0.5, 1.0, 1.5, 2.0)  # of the throw, as the paper's Fig. 8


def read_target(shop: Workshop, picture_path: Path) -> Array:
    """Picture file -> target irradiance (ny, nx) in the work frame; target.png."""
    width_mm, height_mm = shop.spec.optics.screen_size_mm
    with shop.watch.stage("picture"):
        picture = read_picture(picture_path, shop.spec.image, rows=shop.spec.pixel_rows, aspect=width_mm / height_mm)
        target = target_irradiance(picture.linear, viewed_from=shop.spec.optics.viewed_from)
        shop.save("target.png", figures.picture_png(_as_seen(shop, target), white=float(target.max())))
    for sentence in picture.warnings:
        shop.note("optics", sentence)
    shop.report["source"] = {
        "file": picture.file_name, "width": picture.width, "height": picture.height, "mode": picture.mode,
    }  # fmt: skip
    return target


def design_stage(shop: Workshop, target: Array) -> LensDesign:
    """Target -> lens: heightfield.npz, map.npz, lens.png; fills the design's part of report `optics`."""
    with shop.watch.stage("lens") as reached:
        design = design_lens(target, lens_settings(shop.spec), on_progress=lambda _, share: reached(share))
        facts = measure_lens(design.heightfield)
        save_heightfield(shop.folder, design.heightfield)
        save_map(shop.folder, design.transport_map, target)
    shop.report["optics"] = {
        "method": shop.spec.optics.method,
        "converged": design.converged,
        "message": design.message,
        "history": design.history,
        **_facts(facts),
    }
    if design.flow is not None:
        picture = figures_lens.flow_png(design.flow.snapshots, viewed_from=shop.spec.optics.viewed_from)
        shop.save("flow.png", picture)
    if not design.converged:
        shop.note("optics", f"the lens design has not converged: {design.message}")
    return design


def require_fit_in_stock(shop: Workshop, heightfield: Heightfield) -> None:
    """ReliefTooDeep unless enough of the block is left under the deepest point."""
    solid.require_floor(heightfield, thickness_mm=shop.spec.stock.thickness_mm, min_floor_mm=MIN_FLOOR_MM)


def caustic_stage(shop: Workshop, heightfield: Heightfield, target: Array) -> None:
    """Simulated light: scores into report `optics`, caustic.png, comparison.png, through-focus.png."""
    settings = lens_settings(shop.spec)
    white = float(target.max())
    with shop.watch.stage("caustic") as reached:
        series = []
        for number, factor in enumerate(THROUGH_FOCUS):
            caustic = simulate_caustic(
                heightfield,
                throw_mm=factor * settings.throw_mm,
                refractive_index=settings.refractive_index,
                screen=settings.screen,
                pixels=(target.shape[0], target.shape[1]),
                tubes_per_cell=4 if factor == 1.0 else 2,
            )
            series.append((factor, _as_seen(shop, caustic.irradiance)))
            if factor == 1.0:
                score = score_caustic(caustic.irradiance, target)
                in_focus = caustic
            reached((number + 1) / (len(THROUGH_FOCUS) + 1))
        seen, wanted = _as_seen(shop, in_focus.irradiance), _as_seen(shop, target)
        shop.save("caustic.png", figures.picture_png(seen, white=white))
        shop.save("comparison.png", figures.comparison_png(wanted, seen))
        shop.save("through-focus.png", figures.through_focus_png(series, throw_mm=settings.throw_mm, white=white))
    shop.report.setdefault("optics", {}).update(
        psnr_db=_finite(score.psnr_db),
        ssim=score.ssim,
        misplaced_light=score.misplaced_light,
        dark_leak=score.dark_leak,
        outside_share=in_focus.outside_share,
        reflected_share=in_focus.reflected_share,
    )
    if in_focus.reflected_share > 1e-6:
        share = 100 * in_focus.reflected_share
        shop.note("optics", f"{share:.2g} % of the light is totally reflected inside the lens; a longer throw helps")


def solid_stage(shop: Workshop, heightfield: Heightfield) -> None:
    """lens.stl and lens.png: for looking at, never for CAM."""
    stock = shop.spec.stock
    with shop.watch.stage("solid"):
        mesh = solid.lens_solid(
            heightfield, thickness_mm=stock.thickness_mm, margin_mm=stock.margin_mm, min_floor_mm=MIN_FLOOR_MM
        )
        shop.save("lens.stl", solid.stl_bytes(mesh))
        picture = figures_lens.heightfield_png(heightfield.x_mm, heightfield.y_mm, heightfield.z_mm)
        shop.save("lens.png", picture)


def _as_seen(shop: Workshop, irradiance: Array) -> Array:
    return picture_from_irradiance(irradiance, viewed_from=shop.spec.optics.viewed_from)


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
