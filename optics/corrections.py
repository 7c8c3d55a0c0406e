"""The passes of the transport method: each solves the map, shapes the lens, simulates its light, and corrects the aim
by the error.

Correction: g <- max(0, g + T - I), and the map is solved again from its present state; I is the light of the lens as it
will be cut, with valleys filled until the ball fits, under the whole source. The best pass is kept. The later descent
(`polish`) accounts for the finish.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.ball_fit import ball_fits, fit_ball
from optics.caustic import Caustic, simulate_caustic
from optics.closing import close_to_radius
from optics.errors import NoSurfaceError
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.metrics import CausticScore, score_caustic
from optics.outcomes import DESIGN_BEAMS
from optics.spline import Array
from optics.transport.solver import OpticalPath, solve_transport

_CLOSING_PER_BALL = 1.25  # wider than the ball, because a closing is not exact; 1 or 1.5 score less after the fit
_MOST_LOST = 0.05  # of the light, for a lens that counts as converged
_TUBES_PER_PIXEL = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosingCost:
    """Loss of picture quality by shaping the lens for a ball of radius_mm, before polish.

    The scores with shaping are those of the best pass. The scores without it are an estimate: the scores with shaping
    plus the difference that shaping makes in the first pass. In tests where the lens without shaping was also
    corrected, the estimate was within 0.5 dB.
    """

    radius_mm: float
    psnr_db_without: float
    psnr_db_with: float
    dark_leak_without: float
    dark_leak_with: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pass:
    """One solution, its lens, the light through it, and its scores."""

    path: OpticalPath
    lens: Heightfield
    caustic: Caustic
    score: CausticScore

    @property
    def lost_share(self) -> float:
        """Share of the light that misses the screen or is reflected."""
        return self.caustic.outside_share + self.caustic.reflected_share

    @property
    def loses_light(self) -> bool:
        return self.lost_share > _MOST_LOST

    @property
    def converged(self) -> bool:
        return self.path.converged and not self.loses_light


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corrected:
    """The best pass, the first pass, the lens of the first pass before it was shaped, and a record of each pass."""

    best: Pass
    first: Pass
    raw: Heightfield
    history: list[dict[str, Any]]

    @property
    def is_shaped(self) -> bool:
        """Whether the ball did not fit everywhere, so that the lens was shaped for it."""
        return self.first.lens is not self.raw


Progress = Callable[[str, float], None]


def correct_lens(
    target: Array,
    settings: LensSettings,
    report: Progress = lambda stage, share: None,
    *,
    first: OpticalPath | None = None,
) -> Corrected:
    """Return the lens for a target (ny, nx), work frame, mean 1, after the settings' number of corrections.

    first : the target's own solution, if it is known; it is the same for balls of all sizes
    """
    report("transport map", 0.0)
    path = first or solve_transport(
        target, settings.bench, skim_mm=settings.skim_mm, on_progress=lambda share: report("transport map", share)
    )
    raw = _build_lens(path, settings)
    latest = best = unaided = _evaluate(path, raw, target, settings)
    history = [_record(0, latest)]
    aim = target
    for number in range(1, settings.corrections + 1):
        report("corrections", (number - 1) / settings.corrections)
        aim = np.maximum(aim + target - latest.caustic.irradiance, 0.0)
        path = solve_transport(aim, settings.bench, skim_mm=settings.skim_mm, start=latest.path)
        try:
            latest = _evaluate(path, _build_lens(path, settings), target, settings)
        except NoSurfaceError:  # keep the passes so far
            break
        history.append(_record(number, latest))
        if latest.score.psnr_db > best.score.psnr_db:  # stripes a pixel wide get worse
            best = latest
    report("corrections", 1.0)
    return Corrected(best=best, first=unaided, raw=raw, history=history)


def _build_lens(path: OpticalPath, settings: LensSettings) -> Heightfield:
    """Return the lens at its vertices, top a skim below Z0."""
    ny, nx = path.path_mm.shape
    x_mm = np.linspace(0.0, settings.bench.width_mm, settings.vertices(nx))
    y_mm = np.linspace(0.0, settings.bench.height_mm, settings.vertices(ny))
    t = path.heights_mm(x_mm, y_mm)
    lens = Heightfield(x_mm=x_mm, y_mm=y_mm, z_mm=t - t.max() - settings.skim_mm)
    return lens if settings.finish is None else replace(lens, rim_mm=settings.finish.seen_beyond_mm)


def _fill_valleys(raw: Heightfield, settings: LensSettings) -> Heightfield:
    """Return the lens with its valleys filled until the ball fits; the lens itself if it fits already.

    Closing fills them as the ball would leave them, but not exactly on the grid; the fit does the rest.
    """
    ball_mm = settings.closing_radius_mm
    if ball_mm <= 0 or ball_fits(raw, ball_mm):
        return raw
    z = close_to_radius(raw.z_mm, radius_mm=_CLOSING_PER_BALL * ball_mm, dx_mm=raw.dx_mm, dy_mm=raw.dy_mm)
    return fit_ball(replace(raw, z_mm=z - z.max() - settings.skim_mm), ball_mm)


def _simulate_light(lens: Heightfield, target: Array, settings: LensSettings) -> Caustic:
    return simulate_caustic(
        lens,
        settings.bench.flawless,
        pixels=target.shape,
        tubes_per_cell=max(1, _TUBES_PER_PIXEL * target.shape[1] // (lens.x_mm.size - 1)),
        beams=DESIGN_BEAMS,
    )


def _evaluate(path: OpticalPath, raw: Heightfield, target: Array, settings: LensSettings) -> Pass:
    lens = _fill_valleys(raw, settings)
    caustic = _simulate_light(lens, target, settings)
    return Pass(path=path, lens=lens, caustic=caustic, score=score_caustic(caustic.irradiance, target))


def measure_closing_cost(done: Corrected, target: Array, settings: LensSettings) -> ClosingCost | None:
    """Return the cost of closing; None if nothing was filled."""
    if not done.is_shaped:
        return None
    best, first = done.best.score, done.first.score
    without = score_caustic(_simulate_light(done.raw, target, settings).irradiance, target)
    return ClosingCost(
        radius_mm=settings.closing_radius_mm,
        psnr_db_without=best.psnr_db + without.psnr_db - first.psnr_db,
        psnr_db_with=best.psnr_db,
        dark_leak_without=max(0.0, best.dark_leak + without.dark_leak - first.dark_leak),
        dark_leak_with=best.dark_leak,
    )


def _record(number: int, seen: Pass) -> dict[str, Any]:
    return {
        "pass": number,
        "iterations": {str(level.pixels): level.iterations for level in seen.path.levels},
        "rms": seen.path.levels[-1].rms,
        "psnr_db": seen.score.psnr_db,
        "ssim": seen.score.ssim,
        "misplaced_light": seen.score.misplaced_light,
        "lost_light": seen.lost_share,
    }
