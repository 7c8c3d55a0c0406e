"""From a target irradiance to a lens: the map, the surface, and corrections against its own simulated caustic.

Correction: what the light lacks is added to the aim, g <- max(0, g + T - I), and the map solved again from where it
was. The best pass is kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.caustic import Caustic, simulate_caustic
from optics.closing import closed_to_radius
from optics.flow import PaperFlow
from optics.heightfield import Heightfield
from optics.map_inversion import screen_positions
from optics.metrics import CausticScore, score_caustic
from optics.optical_path import heights_mm
from optics.paper_surface import paper_lens
from optics.settings import LensSettings
from optics.spline import Array
from optics.transport import TOLERANCE, OpticalPath, solve_transport
from optics.transport_map import TransportMap

CLOSING_PER_BALL = 1.5  # the closing lets curvature of 1.5 / radius through, so it closes wider than the ball
_MOST_LOST = 0.05  # of the light, for a lens that counts as converged


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensDesign:
    """A lens and how it came about. Where not `converged`, `message` says how far it got; the lens is usable still."""

    heightfield: Heightfield
    transport_map: TransportMap
    converged: bool
    history: list[dict[str, Any]]
    message: str
    seconds: float
    flow: PaperFlow | None = None  # the paper's method step by step, where that was the method


Progress = Callable[[str, float], None]


def design_lens(target: Array, settings: LensSettings, *, on_progress: Progress | None = None) -> LensDesign:
    """The lens that paints `target` (ny, nx), work frame, mean 1, by the chosen method."""
    report = on_progress or (lambda stage, share: None)
    method = _by_transport if settings.method == "transport" else _by_the_paper
    return method(target, settings, report)


def _by_the_paper(target: Array, settings: LensSettings, report: Progress) -> LensDesign:
    started = time.perf_counter()
    ny, nx = target.shape
    lens = paper_lens(
        target,
        width_mm=settings.bench.width_mm,
        height_mm=settings.bench.height_mm,
        throw_mm=settings.bench.throw_mm,
        refractive_index=settings.bench.refractive_index,
        screen_width_mm=settings.bench.screen.width_mm,
        screen_height_mm=settings.bench.screen.height_mm,
        skim_mm=settings.skim_mm,
        vertices_x=settings.vertices(nx),
        vertices_y=settings.vertices(ny),
        on_progress=report,
    )
    return LensDesign(
        heightfield=lens.heightfield,
        transport_map=TransportMap(screen_mm=lens.screen_mm, lens_mm=lens.lens_mm),
        converged=lens.converged,
        history=lens.history(),
        message=lens.message,
        seconds=time.perf_counter() - started,
        flow=lens.flow,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pass:
    """One solution, its lens, the light through it, and how that scores."""

    path: OpticalPath
    lens: Heightfield
    caustic: Caustic
    score: CausticScore

    @property
    def lost_share(self) -> float:
        """Of the light: what misses the screen or is reflected."""
        return self.caustic.outside_share + self.caustic.reflected_share

    @property
    def converged(self) -> bool:
        return self.path.converged and self.lost_share <= _MOST_LOST


def _by_transport(target: Array, settings: LensSettings, report: Progress) -> LensDesign:
    started = time.perf_counter()
    report("transport map", 0.0)
    path = solve_transport(
        target, settings.bench, skim_mm=settings.skim_mm, on_progress=lambda share: report("transport map", share)
    )
    latest = best = _seen(path, target, settings)
    history = [_pass_record(0, latest)]
    aim = target
    for number in range(1, settings.corrections + 1):
        report("corrections", (number - 1) / settings.corrections)
        aim = np.maximum(aim + target - latest.caustic.irradiance, 0.0)
        path = solve_transport(aim, settings.bench, skim_mm=settings.skim_mm, start=latest.path)
        latest = _seen(path, target, settings)
        history.append(_pass_record(number, latest))
        if latest.score.psnr_db > best.score.psnr_db:  # stripes a pixel wide get worse
            best = latest
    report("corrections", 1.0)
    return LensDesign(
        heightfield=best.lens,
        transport_map=best.path.transport_map(),
        converged=best.converged,
        history=history,
        message=_message(best),
        seconds=time.perf_counter() - started,
    )


def _seen(path: OpticalPath, target: Array, settings: LensSettings) -> _Pass:
    lens = _surface(path, settings)
    caustic = simulate_caustic(lens, settings.bench, pixels=target.shape, tubes_per_cell=2)
    return _Pass(path=path, lens=lens, caustic=caustic, score=score_caustic(caustic.irradiance, target))


def _surface(path: OpticalPath, settings: LensSettings) -> Heightfield:
    """Heights at the lens vertices: invert the map, then the closed form of optical_path.heights_mm."""
    ny, nx = path.path_mm.shape
    x_mm = np.linspace(0.0, settings.bench.width_mm, settings.vertices(nx))
    y_mm = np.linspace(0.0, settings.bench.height_mm, settings.vertices(ny))
    corners = path.transport_map().lens_mm
    u, v = screen_positions(corners[..., 0], corners[..., 1], x_mm, y_mm)
    t = heights_mm(path.path_mm, u, v, x_mm, y_mm, settings.bench)
    if settings.min_radius_mm > 0:
        t = closed_to_radius(
            t, radius_mm=CLOSING_PER_BALL * settings.min_radius_mm, dx_mm=x_mm[1] - x_mm[0], dy_mm=y_mm[1] - y_mm[0]
        )
    return Heightfield(x_mm=x_mm, y_mm=y_mm, z_mm=t - t.max() - settings.skim_mm)


def _pass_record(number: int, seen: _Pass) -> dict[str, Any]:
    return {
        "pass": number,
        "iterations": {str(level.pixels): level.iterations for level in seen.path.levels},
        "rms": seen.path.levels[-1].rms,
        "psnr_db": seen.score.psnr_db,
        "ssim": seen.score.ssim,
        "misplaced_light": seen.score.misplaced_light,
        "lost_light": seen.lost_share,
    }


def _message(seen: _Pass) -> str:
    last, lost = seen.path.levels[-1], seen.lost_share
    way = f"rms {last.rms:.1e} of the mean irradiance after {last.iterations} steps at full size"
    if seen.converged:
        return f"converged: {way}"
    if lost > _MOST_LOST:
        return (
            f"{100 * lost:.0f} % of the light misses the screen: the picture is finer than the lens can show "
            f"(the map has {way})"
        )
    return f"stopped: {way}, wanted {TOLERANCE:g}; the lens is usable, its contrast may be lower than the picture's"
