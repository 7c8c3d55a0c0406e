"""Estimates a job before it runs: relief, hours and blur, from a quick lens and its passes.

The quick estimate takes a second and uses a coarse picture: the large forms of a picture determine the heights, so
relief and hours of a coarse lens are nearly those of the job. Its slopes lack the steepness of fine detail, and its
light lacks the creases for black, which a finish rounds. The exact estimate takes half a minute and uses a lens as fine
as the picture, planned like a job's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import ceil, hypot, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from cam.duration import Kinematics
from cam.passes import PassSpec
from cam.planning.pass_time import LensForm, layers_where_s
from cam.planning.planner import Marks
from cam.planning.rest import Filled, RestExtent
from cam.planning.row_slopes import RowSlopes, row_slopes
from cam.planning.sampled_time import FEW_ROWS, ROWS, first_pass_s, rows_s
from cam.surface.tool_surface import compute_left_by_flat
from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.closing import close_to_radius
from optics.design import LensDesign, design_lens
from optics.heightfield import Array, Heightfield
from optics.lens_settings import LensSettings
from optics.tolerance import blur_mm, source_rad
from phrases.phrase import Phrase, phrases_in
from service.errors import InputError, SpecError
from service.job.errors import translate_errors
from service.job.files import AFTER_PASSES, FACE
from service.job.picture import PictureLimits
from service.job.picture.decoding import decode_picture
from service.job.picture.reading import Picture, picture_of
from service.job.planning.around import paths_around, seconds_of
from service.job.planning.changes import Change, changes_of
from service.job.planning.finished_light import FinishedLight, blur_of
from service.job.planning.fit import check_ball_fit, require_flutes
from service.job.planning.lens_facts import LensFacts, measure_lens
from service.job.planning.lenses import FinishDesigns, compute_passes, form_of, simplify
from service.job.planning.planner import plan_for_picture
from service.job.planning.predicted_light import PictureLight, PredictedPicture, describe_light, draw_wall
from service.job.planning.preparation import aim_at_picture
from service.job.planning.rim_room import RimRoom, measure_rim_room, warn_of_rim_room
from service.job.spec.cutting import MIN_FLOOR_MM
from service.job.spec.envelope import require_envelope
from service.job.spec.lens_task import (
    branch_of,
    explain_blocked_light,
    finish_of,
    lens_settings,
    require_contrast,
    warn_of_reflection,
    with_branch,
)
from service.job.spec.model import JobSpec, PassRow
from service.job.spec.resolve import ResolvedJob, cam_passes_of, digits_of, post_of, warn_of_removal, with_plan
from service.job.stages.kept_plans import NO_PLANS, KeptPlans, PlanChoice
from service.wording import ball, cutter

MOST_PIXELS = 512
"""Most pixels of the compared picture: finer detail hardly affects recognition."""
PIXELS = 96
"""Along the longer side of the picture from which the lens is made."""

_STEEP_DEG = 45.0
_WORTH_DB = 1.0  # least gain of a change
_REFLECTED = 1e-6  # share of the light; less is a rounding error
_WIDTH = 2.355  # full width of a blur at half its height, in standard deviations
_TUBES, _BEAMS = 2, 7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QuickLens:
    """A quick lens of a job, from a coarse picture.

    job      : with its passes, planned if they were not given
    planned  : whether they were planned
    seconds  : of each pass, if the plan knows them
    see      : returns the predicted picture, if the plan knows it
    choices  : plans to choose from, if the job itself was planned
    settings : of the job's own lens
    aim      : (ny, nx) coarse target
    missed   : (ny, nx) its light minus the aim
    """

    job: ResolvedJob
    planned: bool
    seconds: tuple[float, ...]
    see: Callable[[], PredictedPicture] | None
    choices: Sequence[PlanChoice]
    settings: LensSettings
    design: LensDesign
    facts: LensFacts
    form: LensForm
    aim: Array
    missed: Array
    reflected_share: float

    @property
    def spec(self) -> JobSpec:
        return self.job.spec

    @property
    def lens(self) -> Heightfield:
        return self.design.heightfield

    @property
    def bench(self) -> Bench:
        return self.settings.bench


def estimate(
    job: ResolvedJob,
    path: Path,
    *,
    limits: PictureLimits,
    name: str,
    exactly: bool = False,
    plans: KeptPlans = NO_PLANS,
) -> dict[str, Any]:
    """Return the answer of POST /v1/estimates. InputError or PictureError if the job would fail at once.

    plans : where an exact estimate finds its plan, or leaves it for the job
    """
    spec, fine, coarse = job.spec, _with_pixels(job.spec, MOST_PIXELS), coarse_spec(job.spec)
    exactly = exactly or coarse == fine
    with translate_errors():
        specs = [fine, spec] if exactly else [coarse, fine, spec]
        targets, picture = _targets(path, *specs, limits=limits, name=name)
        whole, own = targets[-2:]
        if specs[0] != spec:
            job = job.with_spec(with_branch(specs[0], own))
        quick = quick_lens(job, targets[0], None if exactly else whole, plans)
        passes = _with_around(quick.job, list(_hours(quick)))
        seen = _predict_picture(quick, whole, exactly=exactly)
        blur = _blur(quick, 0.0 if seen is None else seen.detail_mm)
    own_px_mm = spec.optics.screen_size_mm[0] / spec.image.pixels
    detail_mm = max(own_px_mm, blur.detail_mm)
    refusals = list(_refusals(quick))
    warnings = [Phrase("{picture} {sentence}", picture=name, sentence=one) for one in picture.warnings]
    answer = {
        "relief_mm": quick.lens.relief_mm,
        "max_slope_deg": quick.facts.max_slope_deg,
        "thickness_ok": _floor_mm(quick) >= MIN_FLOOR_MM,
        "throw_ok": quick.reflected_share <= _REFLECTED and quick.facts.max_slope_deg <= _STEEP_DEG,
        "smallest_detail_mm": detail_mm,
        "passes": passes,
        "planned": quick.planned,
        "exact": exactly,
        "hours": sum(row["hours"] for row in passes),
        "blur_mm": blur.whole_mm,
        "psnr_db": None if seen is None else seen.psnr_db,
        "seen_db": None if seen is None else seen.seen_db,
        "wall": None if seen is None else draw_wall(seen, spec.optics.viewed_from),
        "blur_by": {"light_mm": blur.light_mm, "milling_mm": blur.milling_mm},
        "plans": list(_plan_rows(quick, own_px_mm, passes)),
        "refusals": refusals,
        "warnings": list(dict.fromkeys([*warnings, *_warnings(quick), *blur.words(own_px_mm)])),
        "changes": [asdict(change) for change in changes_of(job, detail_mm)],
        "picture": {"width": picture.width, "height": picture.height},
        "spec": spec.model_copy(update={"passes": quick.spec.passes}).plain(),
    }
    return {**answer, "phrases": phrases_in(answer)}


def suggest_changes(job: ResolvedJob, path: Path, *, limits: PictureLimits) -> Iterator[tuple[Change, dict[str, Any]]]:
    """Yield single changes of a job that show clearly more of its picture, with their estimates; skip refused ones."""
    own = estimate(job, path, limits=limits, name=path.name)
    for change in changes_of(job, own["smallest_detail_mm"]):
        try:
            found = estimate(change.apply_to(job), path, limits=limits, name=path.name)
        except InputError:
            continue
        if not found["refusals"] and (found["psnr_db"] or 0.0) >= (own["psnr_db"] or 0.0) + _WORTH_DB:
            yield change, found


def _targets(path: Path, *specs: JobSpec, limits: PictureLimits, name: str) -> tuple[list[Array], Picture]:
    """Return the target of a lens for each spec, and the picture of the last one; it is decoded once, and not kept."""
    decoded = decode_picture(path, limits, name)
    found: list[Array] = []
    for number, spec in enumerate(specs):
        if number and spec == specs[number - 1]:
            found.append(found[-1])
            continue
        width_mm, height_mm = spec.optics.screen_size_mm
        picture = picture_of(decoded, spec.image, rows=spec.pixel_rows, aspect=width_mm / height_mm, name=name)
        found.append(aim_at_picture(spec, picture.linear).target)
        require_contrast(spec, found[-1])
    return found, picture


def coarse_spec(spec: JobSpec) -> JobSpec:
    """Return the job with a coarser picture."""
    return _with_pixels(spec, PIXELS)


def _with_pixels(spec: JobSpec, most: int) -> JobSpec:
    """Return the spec with at most that many pixels along the longer side."""
    scale = min(1.0, most / max(spec.image.pixels, spec.pixel_rows))
    pixels = max(16, round(scale * spec.image.pixels))
    return spec.model_copy(update={"image": spec.image.model_copy(update={"pixels": pixels})})


def quick_lens(job: ResolvedJob, target: Array, whole: Array | None, plans: KeptPlans = NO_PLANS) -> QuickLens:
    """Return the lens for a target (ny, nx), work frame, mean 1, always by the default method.

    whole : the same target with more pixels, for comparing finishes; None: the plan is the job's, one of `plans`
    """
    seconds: tuple[float, ...] = ()
    see: Callable[[], PredictedPicture] | None = None
    choices: Sequence[PlanChoice] = ()
    is_planned = job.spec.to_be_planned
    if is_planned and whole is None:
        made = plans.make(job, target, at_once=True)
        job, see, choices = job.with_spec(with_plan(job.spec, {"plan": made.figures})), made.see, made.choices()
    elif is_planned:
        planned = plan_for_picture(job, target, whole=whole)
        job, seconds = job.with_spec(with_plan(job.spec, {"plan": planned.settings()})), planned.chosen.seconds
        if planned.finishing is not None:
            see = partial(describe_light, planned.light, planned.chosen.marks)
    spec = job.spec
    settings = lens_settings(spec, branch=branch_of(spec, target))
    quick = simplify(settings)
    design = design_lens(target, quick, passes=compute_passes(target, quick))
    lens, shape = design.heightfield, (target.shape[0], target.shape[1])
    seen = simulate_caustic(lens, quick.bench.clear, pixels=shape, tubes_per_cell=_TUBES, beams=_BEAMS)
    return QuickLens(
        job=job,
        planned=is_planned,
        seconds=seconds,
        see=see,
        choices=choices,
        settings=settings,
        design=design,
        facts=measure_lens(lens),
        form=form_of(lens),
        aim=target,
        missed=seen.irradiance - target,
        reflected_share=seen.reflected_share,
    )


def _hours(quick: QuickLens) -> Iterator[dict[str, Any]]:
    """Yield the hours of each pass: those of the plan, or computed from the stock that the pass before leaves."""
    specs = cam_passes_of(quick.spec)
    known_s = quick.seconds
    if not specs[0].is_ball:  # the plan has only guessed the stock after a flat end mill
        known_s = known_s[:1]
    times_s = known_s if len(known_s) == len(specs) else tuple(_time_passes_s(quick, specs, known_s))
    for spec, seconds in zip(specs, times_s, strict=True):
        yield {"name": spec.name, "tool": cutter(asdict(spec)), "hours": seconds / 3600}


def _time_passes_s(quick: QuickLens, specs: tuple[PassSpec, ...], known_s: tuple[float, ...]) -> Iterator[float]:
    """Yield the seconds of each pass; known_s: those of the first, if known."""
    form, machine = quick.form, quick.job.machine
    mill, digits = Kinematics.of(machine), digits_of(machine)
    stock_mm: Array | None = None
    for spec in specs:
        made_mm = _compute_heights_left(quick.lens, spec)
        if stock_mm is not None:
            seconds = _seconds_after(quick, spec, stock_mm - made_mm, made_rows=FEW_ROWS if known_s else ROWS)
        elif known_s:
            seconds = known_s[0]
        else:
            seconds = first_pass_s(form, spec, mill, digits, safe_z_mm=machine.safe_z_mm)
        stock_mm = made_mm if stock_mm is None else np.minimum(stock_mm, made_mm)
        yield seconds


def _with_around(job: ResolvedJob, passes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the hours with those of the programs before and after the passes."""
    rates = job.machine.max_rate_mm_per_min
    around = {
        name: {
            "name": name,
            "tool": Phrase("cutter {size}", size=ball(radius_mm)),
            "hours": seconds_of(paths, min(rates)) / 3600,
        }
        for name, radius_mm, paths in paths_around(job)
    }
    first, last = ([around[name] for name in names if name in around] for names in ((FACE,), AFTER_PASSES))
    return [*first, *passes, *last]


def _plan_rows(quick: QuickLens, own_px_mm: float, own: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the plans to choose from, in the API's form; own: the passes of the estimate itself."""
    for one in quick.choices:
        specs = tuple(PassRow.model_validate(row) for row in one.spec["passes"])
        job = quick.job.with_spec(quick.spec.model_copy(update={"passes": specs}))
        rows = zip(one.spec["passes"], one.seconds, strict=True)
        timed = [{"name": spec["name"], "tool": cutter(spec), "hours": seconds / 3600} for spec, seconds in rows]
        passes = own if one.is_chosen else _with_around(job, timed)
        yield {
            "is_chosen": one.is_chosen,
            "hours": sum(row["hours"] for row in passes),
            "hand_min": one.spec["finish"].get("minutes"),
            "passes": passes,
            "psnr_db": one.psnr_db,
            "seen_db": one.seen_db,
            "smallest_detail_mm": max(own_px_mm, _blur(quick, one.detail_mm).detail_mm),
            "wall": one.wall,
            "spec": one.spec,
        }


def _seconds_after(quick: QuickLens, spec: PassSpec, depth_mm: Array, *, made_rows: int) -> float:
    """Return the seconds of a later pass; depth_mm (ny, nx): the stock that it takes off."""
    form, machine = quick.form, quick.job.machine
    mill = Kinematics.of(machine)
    if spec.where == "rest":
        return RestExtent.of(Filled(lens=quick.lens, over_mm=depth_mm), form, spec, mill).seconds
    own_s = rows_s(form, spec, mill, digits_of(machine), made_rows=made_rows)
    return own_s + layers_where_s(form, spec, depth_mm, mill)


def _compute_heights_left(lens: Heightfield, spec: PassSpec) -> Array:
    """Return the heights (ny, nx) that a pass leaves: the lens as its ball reaches it, its cusps and its stock to
    leave.
    """
    if not spec.is_ball:
        return compute_left_by_flat(lens, spec)
    spline_z = lens.z_mm
    filled = close_to_radius(spline_z, radius_mm=spec.radius_mm, dx_mm=lens.dx_mm, dy_mm=lens.dy_mm)
    slope = np.hypot(*np.gradient(spline_z, lens.dy_mm, lens.dx_mm))
    normal_mm = spec.stock_to_leave_mm + spec.pitch_mm**2 / (8 * spec.radius_mm)
    return np.asarray(filled + normal_mm * np.sqrt(1.0 + slope**2))


@dataclass(frozen=True, slots=True, kw_only=True)
class Blur:
    """Root mean squares on the screen, both directions together; detail_mm: how wide the worse one blurs a point."""

    milling_mm: float
    light_mm: float
    detail_mm: float

    @property
    def whole_mm(self) -> float:
        return hypot(self.milling_mm, self.light_mm)

    def words(self, pixel_mm: float) -> Iterator[Phrase]:
        if self.detail_mm <= pixel_mm:
            return
        if self.light_mm > self.milling_mm:
            yield Phrase("details under {detail_mm:.2g} mm will blur: the light's own size", detail_mm=self.detail_mm)
        else:
            yield Phrase("details under {detail_mm:.2g} mm will blur: the tool's marks", detail_mm=self.detail_mm)


def _blur(quick: QuickLens, marks_mm: float) -> Blur:
    """Return the blur of a lens; marks_mm: the smallest detail that the tool's marks leave."""
    disc_mm = blur_mm(quick.lens, quick.bench, source_rad(quick.lens, quick.bench))
    return Blur(
        milling_mm=_blur_of_milling_mm(quick),
        light_mm=disc_mm / 4 * sqrt(2),
        detail_mm=hypot(marks_mm, _WIDTH * disc_mm / 4),
    )


def _blur_of_milling_mm(quick: QuickLens) -> float:
    """Return the blur that the tool leaves, or the finish by hand after it."""
    if (finish := finish_of(quick.spec)) is not None:
        return blur_of(finish)
    if (slopes := _slopes(quick)) is None:
        return 0.0
    drop_mm = quick.bench.throw_mm - float(quick.lens.z_mm.mean())
    reach_mm = drop_mm * (2.0 if quick.bench.mirror else quick.bench.refractive_index - 1.0)
    return reach_mm * hypot(slopes.across.rms, slopes.along.rms)


def _predict_picture(quick: QuickLens, target: Array, *, exactly: bool) -> PredictedPicture | None:
    """Predict what the milled lens shows of a target (ny, nx); None if no pass finishes the lens."""
    finish, slopes = _find_finish(quick), _slopes(quick)
    if finish is None or slopes is None:
        return None
    if quick.see is not None:
        return quick.see()
    marks, by_hand = Marks(spec=finish, slopes=slopes), finish_of(quick.spec)
    light = PictureLight(target, quick.bench, aims=any(quick.spec.optics.foreseen_blur_mm))
    light.add(marks.radius_mm, quick.form, quick.missed)
    if by_hand is None:
        return describe_light(light, marks)
    finished, design = FinishedLight(light, by_hand), FinishDesigns(target if exactly else quick.aim, quick.settings)
    finished.calibrate(marks, design, fine=exactly)
    if not exactly:
        finished.look_at(marks, design)
    return describe_light(finished, marks)


def _find_finish(quick: QuickLens) -> PassSpec | None:
    """Return the last pass that finishes the whole lens."""
    finishes = [spec for spec in cam_passes_of(quick.spec) if spec.finishes and spec.where == "everywhere"]
    return finishes[-1] if finishes else None


def _slopes(quick: QuickLens) -> RowSlopes | None:
    """Return the slope errors that the last finishing pass leaves; None if no pass finishes."""
    machine, finish = quick.job.machine, _find_finish(quick)
    if finish is None:
        return None
    digit_mm = post_of(machine).digits.z_mm
    step_mm = max(machine.step_mm, digit_mm)
    return row_slopes(
        radius_mm=finish.radius_mm,
        pitch_mm=finish.pitch_mm,
        step_mm=step_mm,
        noise_mm=machine.z_noise_mm,
        vertex_mm=quick.form.usual_chord_mm(finish),
        whole_steps=machine.whole_steps or digit_mm >= machine.step_mm,
        tooth_rad=quick.form.tooth_slopes_rad(finish, step_mm),
    )


def _floor_mm(quick: QuickLens) -> float:
    return quick.spec.stock.thickness_mm - quick.form.deepest_mm


def _refusals(quick: QuickLens) -> Iterator[dict[str, Any]]:
    """Yield the reasons why the job would fail before it has a program, in the API's form."""
    spec, passes = quick.spec, cam_passes_of(quick.spec)
    if (floor_mm := _floor_mm(quick)) < MIN_FLOOR_MM:
        need_mm = ceil(quick.form.deepest_mm + MIN_FLOOR_MM)
        words = Phrase(
            "the lens is {deepest_mm:.1f} mm deep and leaves {floor_mm:.1f} mm of the block: a block of {need_mm} mm, "
            "a wall farther away or a smaller lens",
            deepest_mm=quick.form.deepest_mm,
            floor_mm=floor_mm,
            need_mm=need_mm,
        )
        yield from SpecError([("stock.thickness_mm", words)], {"stock.thickness_mm": need_mm}).rows()
    try:
        lowest_mm = [quick.form.lowest_tip_mm(one.radius_mm) for one in passes]
        require_envelope(spec, quick.job.machine, depth_mm=quick.form.deepest_mm, lowest_mm=lowest_mm)
        require_flutes(quick.lens, passes)
        check_ball_fit(quick.facts, passes, shaped_for_mm=spec.lens_radius_mm)
    except SpecError as error:
        yield from error.rows()


def _rim_room(quick: QuickLens) -> RimRoom | None:
    finish, passes = finish_of(quick.spec), cam_passes_of(quick.spec)
    if finish is None:
        return None
    return measure_rim_room(quick.lens, passes, finish, margin_mm=quick.spec.stock.margin_mm)


def _warnings(quick: QuickLens) -> Iterator[Phrase]:
    yield from (advice.words for advice in quick.design.warnings)
    yield from warn_of_removal(quick.spec, quick.job.machine)
    if unreached := warn_of_rim_room(_rim_room(quick)):
        yield unreached
    if quick.reflected_share > _REFLECTED and quick.spec.optics.surface == "lens":
        yield warn_of_reflection(quick.reflected_share)
    if quick.facts.max_slope_deg > _STEEP_DEG:
        yield Phrase(
            "slopes of {slope_deg:.0f}° are hard to mill; a wall farther away makes them gentler",
            slope_deg=quick.facts.max_slope_deg,
        )
    if blocked := explain_blocked_light(quick.spec):
        yield blocked
