"""The recommended plan against the paper's three passes on the same mill: light as milled, and machine time.

Light by the facets of every groove of the finishing rows (`cam.as_milled`), on lenses designed at full size; hours by
`cam.planning.pass_time`, which tests hold to 5 % of written programs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cam.as_milled.rows import tip_error_mm
from cam.as_milled.surface import MilledSurface
from cam.as_milled.tracks import Noise, Tracks
from cam.contour.path import contour_path
from cam.duration import Kinematics
from cam.moves import cut, rapid
from cam.passes import PassSpec
from cam.planning.pass_time import LensForm, finish_layers_s
from cam.planning.sampled_time import first_pass_s, rows_s
from cam.posts.dialects import POSTS
from cam.rows.rounding import Rounding, on_raster
from cam.rows.vertices import SLOPE_ERROR_RAD, finish_rule
from cam.surface.tool_surface import ToolSurface
from machines.profile import MachineProfile
from optics.design import design_lens
from optics.foreseen import sharpen
from optics.heightfield import Heightfield
from optics.metrics import CausticScore, score_caustic
from optics.milled import simulate_milled
from service.job.planning.plan import Planned
from service.job.planning.planner import plan_for_picture
from service.job.planning.sentences import finish_words
from service.job.spec.loading import resolve_job
from service.job.spec.resolve import ResolvedJob, cam_passes_of
from tests.benchmarks.pictures import PAPER_SETTING, target
from tests.benchmarks.timing import Figure
from tests.cam.programs import row_tracks

NAMES = ("camera", "logo")
MILL = ("machine.step_mm=0.002", "machine.z_noise_mm=0.0005")
_STEEP = 0.89  # cosine of a slope of 0.5


def figures(pixels: int = 512) -> Iterator[Figure]:
    for name in NAMES:
        yield from _against_the_paper(name, target(name, pixels))


def _against_the_paper(name: str, goal: np.ndarray) -> Iterator[Figure]:
    job = resolve_job(preset="recommended", overrides=MILL)
    planned = plan_for_picture(job, goal)
    chosen = planned.chosen
    ours = as_milled(_lens(goal, chosen.finish.radius_mm, planned), goal, chosen.finish, planned.machine)
    paper = resolve_job(preset="paper", overrides=MILL)
    lens = _lens(goal, 0.5, None)
    theirs = as_milled(lens, goal, cam_passes_of(paper.spec)[-1], paper.machine)
    hours = _paper_hours(paper, lens, planned)
    words = finish_words(chosen.finish)
    yield Figure(f"{name}, recommended, as milled", ours.psnr_db, "dB", f"SSIM {ours.ssim:.3f}; {words}")
    yield Figure(
        f"{name}, recommended, foretold", chosen.psnr_db, "dB", f"best possible {planned.plan.best.psnr_db:.2f}"
    )
    yield Figure(f"{name}, recommended", chosen.hours, "h", f"{len(chosen.passes)} passes")
    yield Figure(f"{name}, paper's three passes, as milled", theirs.psnr_db, "dB", f"SSIM {theirs.ssim:.3f}")
    yield Figure(f"{name}, paper's three passes", hours, "h")
    yield Figure(f"{name}, gain", ours.psnr_db - theirs.psnr_db, "dB", f"in {chosen.hours / hours:.2f} of the time")


def _lens(goal: np.ndarray, ball_mm: float, planned: Planned | None) -> Heightfield:
    """Made for that ball and, where there is a plan, sharper by what it blurs."""
    aim = goal
    if planned is not None:
        x_mm, y_mm = planned.foreseen_blur_mm()
        aim = sharpen(goal, (y_mm / planned.light.pixel_mm[0], x_mm / planned.light.pixel_mm[1]))
    return design_lens(aim, replace(PAPER_SETTING, min_radius_mm=ball_mm)).heightfield


def as_milled(lens: Heightfield, goal: np.ndarray, finish: PassSpec, mill: MachineProfile) -> CausticScore:
    """Of the light by way of every groove that the rows of a finishing pass leave on that mill."""
    tracks = _tracks(lens, finish)
    if mill.whole_steps:
        tracks = _on_whole_steps(tracks, mill, finish)
    tracks = tracks.run_on_mill(step_mm=mill.step_mm, noise=Noise.of_pass(finish, mill.z_noise_mm))
    surface = MilledSurface.of_tracks(
        [tracks],
        lens,
        pitch_mm=finish.pitch_mm,
        error_mm=tip_error_mm(step_mm=mill.step_mm, z_noise_mm=mill.z_noise_mm),
        step_mm=mill.step_mm,
    )
    light = simulate_milled(surface.part, surface.parts, lens, PAPER_SETTING.bench, pixels=goal.shape)
    return score_caustic(light.irradiance, goal)


def _tracks(lens: Heightfield, finish: PassSpec) -> Tracks:
    if finish.strategy == "raster":
        return row_tracks(lens, radius_mm=finish.radius_mm, pitch_mm=finish.pitch_mm, direction=finish.direction)
    rule = finish_rule(SLOPE_ERROR_RAD, min(lens.dx_mm, finish.radius_mm / 2))
    surface = ToolSurface.over(lens, radius_mm=finish.radius_mm)
    tips = np.concatenate(list(contour_path(lens, surface, finish, rule, on_progress=lambda share: None)))
    return Tracks(radius_mm=finish.radius_mm, tips_mm=tips, joined=np.arange(len(tips)) > 0)


def _on_whole_steps(tracks: Tracks, mill: MachineProfile, finish: PassSpec) -> Tracks:
    """The same rows with their vertices where a program for that mill has them."""
    digits = POSTS[mill.dialect].digits.coarsen(mill.step_mm)
    start, way = rapid(tracks.tips_mm[0]), cut(tracks.tips_mm[1:], finish.feed_mm_per_min)
    paths = on_raster([start, way], Rounding(digits=digits, pitch_mm=finish.pitch_mm))
    tips = np.concatenate([path.points_mm for path in paths])
    return replace(tracks, tips_mm=tips, joined=np.arange(len(tips)) > 0)


def _paper_hours(paper: ResolvedJob, lens: Heightfield, planned: Planned) -> float:
    form, mill = LensForm.of(lens), Kinematics.of(planned.machine)
    rough, semi, finish = cam_passes_of(paper.spec)
    whole = first_pass_s(form, rough, mill, safe_z_mm=paper.machine.safe_z_mm)
    for spec, before in ((semi, rough), (finish, semi)):
        left_mm = before.stock_to_leave_mm + before.pitch_mm**2 / (8 * before.radius_mm)
        whole += rows_s(form, spec, mill) + finish_layers_s(form, spec, left_mm / _STEEP, mill)
    return whole / 3600
