"""The stage that shines light through the lens: scores and pictures of what it paints."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite

from optics.caustic import Caustic, simulate_caustic
from optics.heightfield import Array
from optics.irradiance import picture_from_irradiance
from optics.metrics import CausticScore, score_caustic
from service.job_files import HEIGHTFIELD, MAP
from service.stages import arrays
from service.stages.lens import lens_settings
from service.stages.workshop import Workshop

THROUGH_FOCUS = (0.5, 1.0, 1.5, 2.0)  # of the throw, as the paper's Fig. 8


def caustic(shop: Workshop) -> None:
    """Simulated light: scores into report `optics`, caustic.png, comparison.png, through-focus.png."""
    heightfield = shop.receive(HEIGHTFIELD, arrays.load_heightfield)
    target = shop.receive(MAP, arrays.load_target)
    bench = lens_settings(shop.spec).bench
    with shop.watch.stage("caustic") as reached:
        seen = []
        for number, factor in enumerate(THROUGH_FOCUS, 1):
            seen.append(
                simulate_caustic(
                    heightfield,
                    replace(bench, throw_mm=factor * bench.throw_mm),
                    pixels=(target.shape[0], target.shape[1]),
                    tubes_per_cell=4 if factor == 1.0 else 2,
                )
            )
            reached(number / (len(THROUGH_FOCUS) + 1))
        in_focus = seen[THROUGH_FOCUS.index(1.0)]
        score = score_caustic(in_focus.irradiance, target)
        _draw(shop, target, seen)
    _tell(shop, in_focus, score)


def _draw(shop: Workshop, target: Array, seen: list[Caustic]) -> None:
    from service import figures  # what it stands on is slow to import

    white = float(target.max())
    pictures = [_as_seen(shop, one.irradiance) for one in seen]
    in_focus = pictures[THROUGH_FOCUS.index(1.0)]
    series = list(zip(THROUGH_FOCUS, pictures, strict=True))
    shop.save("caustic.png", figures.picture_png(in_focus, white=white))
    shop.save("comparison.png", figures.comparison_png(_as_seen(shop, target), in_focus))
    throw_mm = shop.spec.optics.throw_mm
    shop.save("through-focus.png", figures.through_focus_png(series, throw_mm=throw_mm, white=white))


def _tell(shop: Workshop, in_focus: Caustic, score: CausticScore) -> None:
    shop.report["optics"] = {
        "psnr_db": score.psnr_db if isfinite(score.psnr_db) else None,
        "ssim": score.ssim,
        "misplaced_light": score.misplaced_light,
        "dark_leak": score.dark_leak,
        "outside_share": in_focus.outside_share,
        "reflected_share": in_focus.reflected_share,
    }
    if in_focus.reflected_share > 1e-6:
        share = 100 * in_focus.reflected_share
        shop.note("optics", f"{share:.2g} % of the light is totally reflected inside the lens; a longer throw helps")


def _as_seen(shop: Workshop, irradiance: Array) -> Array:
    return picture_from_irradiance(irradiance, viewed_from=shop.spec.optics.viewed_from)
