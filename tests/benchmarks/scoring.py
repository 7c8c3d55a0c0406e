"""A lens designed and looked at, as the sections that score pictures do it: CPU seconds, caustic, sentence."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from cam.surface.stock_touch import largest_fitting_radius_mm
from optics.caustic import Caustic, simulate_caustic
from optics.design import LensDesign, design_lens
from optics.lens_settings import LensSettings
from optics.metrics import CausticScore, score_caustic


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A design, its light under the bench it was made for by 4 x 4 tubes a cell, and what it took."""

    design: LensDesign
    caustic: Caustic
    score: CausticScore
    cpu_s: float

    @property
    def sentence(self) -> str:
        ball = largest_fitting_radius_mm(self.design.heightfield)
        return f"{scores(self.score)}; ball {ball.everywhere_mm:.2f} mm; CPU {self.cpu_s:.1f} s"


def scores(score: CausticScore) -> str:
    """The scores beside PSNR."""
    return (
        f"SSIM {score.ssim:.4f}, misplaced {100 * score.misplaced_light:.2f} %, dark leak {100 * score.dark_leak:.2f} %"
    )


def designed(target: np.ndarray, settings: LensSettings) -> Scored:
    """Design a lens for the target (ny, nx) and score it."""
    started = time.process_time()
    design = design_lens(target, settings)
    cpu_s = time.process_time() - started
    caustic = simulate_caustic(design.heightfield, settings.bench, pixels=target.shape)
    return Scored(design=design, caustic=caustic, score=score_caustic(caustic.irradiance, target), cpu_s=cpu_s)
