"""Paths of the programs around the passes (facing, cut-out), and the time that they take."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress

import numpy as np

from cam.around.paths import (
    ALLOWANCE_MM,
    aperture_corners,
    make_cut_out_paths,
    make_facing_paths,
    make_witness_paths,
    offset_loop,
)
from cam.around.specs import CutOut
from cam.moves import Array
from cam.moves import Path as ToolPath
from optics.witness import NoMarksError
from service.job.files import CUT_OUT, FACE, WITNESS
from service.job.planning.witness import plan_witness
from service.job.spec.resolve import ResolvedJob, cam_stock_of, cut_out_of, facing_task_of, post_of


def paths_around(job: ResolvedJob) -> Iterator[tuple[str, float, list[ToolPath]]]:
    """Yield (name, cutter radius [mm], paths) of the programs around the passes of a whole block, for estimates."""
    spec, stock, machine = job.spec, cam_stock_of(job.spec), job.machine
    if (facing := facing_task_of(spec)) is not None:
        yield FACE, facing.radius_mm, list(make_facing_paths(facing, stock, safe_z_mm=machine.safe_z_mm))
    if spec.passes and spec.finish.witnessed and spec.finish.depth_um is not None:
        with suppress(NoMarksError):
            marks = plan_witness(job).cut
            yield WITNESS, marks.radius_mm, list(make_witness_paths(marks, top_mm=0.0, safe_z_mm=machine.safe_z_mm))
    if (task := cut_out_of(spec)) is not None:
        loop = cut_out_ways(job, task)[1]
        paths = make_cut_out_paths(task, stock, loop, top_mm=0.0, safe_z_mm=machine.safe_z_mm)
        yield CUT_OUT, task.radius_mm, list(paths)


def seconds_of(paths: Iterable[ToolPath], rapid_mm_per_min: float) -> float:
    """Return the time of paths from their lengths and feeds alone [s]."""
    seconds, place = 0.0, None
    for path in paths:
        points = path.points_mm if place is None else np.vstack([place, path.points_mm])
        length_mm = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        seconds += 60 * length_mm / (path.feed_mm_per_min or rapid_mm_per_min)
        place = points[-1]
    return seconds


def lens_corners(job: ResolvedJob) -> Array:
    """Return corners of the lens (k, 2), counter-clockwise."""
    outline = job.spec.optics.outline_mm
    return aperture_corners(cam_stock_of(job.spec)) if outline is None else np.array(outline, dtype=np.float64)


def cut_out_ways(job: ResolvedJob, task: CutOut) -> tuple[Array, Array]:
    """Return corners of the lens (k, 2) and the closed way of the cutter's axis around it (n, 2)."""
    corners = lens_corners(job)
    digit_mm = post_of(job.machine).digits.xy_mm
    return corners, offset_loop(corners, task.radius_mm, allowance_mm=ALLOWANCE_MM + digit_mm)
