"""What too little and too much of a finish show on the wall, and within how many minutes the picture stays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from optics.finish import Finish
from optics.heightfield import Array
from optics.irradiance import picture_from_irradiance
from optics.metrics import score_caustic
from service.job.files import FINISH_TOLERANCE
from service.job.picture.light_png import row_png
from service.job.spec.lens_task import facts_of_light
from service.job.spec.resolved import ResolvedJob
from service.job.stages.context import StageContext

K0_TIMES = (1.25, 0.8)
"""Of the planned k0: too little work, and too much."""

LOSS_DB = 1.0


def report_tolerance(
    context: StageContext, finish: Finish, target: Array, planned: Array, light_of: Callable[[Finish], Array]
) -> None:
    """Report `finish_tolerance` and draw what the wall shows after too little of the finish, as planned, and too much.

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
    """Return how many times the planned minutes lead to so many times the planned k0."""
    process = job.figures.processes.get(job.spec.finish.process)
    exponent = 1 / finish.order if process is None else process.k0_exponent
    return float(k0_times ** (-1 / exponent))


def work_longer(finish: Finish, k0_times: float, minutes_times: float) -> Finish:
    """Return the finish after another time, at the same pressure: what comes off grows with the minutes."""
    depth_mm = None if finish.depth_mm is None else finish.depth_mm * minutes_times
    return replace(finish, k0_rad_per_mm=finish.k0_rad_per_mm * k0_times, depth_mm=depth_mm)


def find_limit(loss_db: float, ratio: float) -> float:
    """Return the ratio of minutes at which LOSS_DB is lost, of a loss that grows with the square of its logarithm and
    is loss_db at `ratio`; never beyond that, where nothing was simulated.
    """
    share = 1.0 if loss_db <= LOSS_DB else math.sqrt(LOSS_DB / loss_db)
    return float(np.exp(share * math.log(ratio)))
