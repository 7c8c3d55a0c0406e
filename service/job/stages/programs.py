"""Stages from the lens to checked programs: generate, write, read back and simulate; the stock left is carried over."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

from cam.around.check import AroundCheck
from cam.around.paths import TRACE_FEED_MM_PER_MIN, trace_paths
from cam.checking.check import PassCheck, check_program
from cam.duration import Kinematics
from cam.moves import Path as ToolPath
from cam.parts import PartLimits
from cam.passes import PassSpec, Stock
from cam.planning.pass_time import LensForm
from cam.posts.post import RML
from cam.program import generate_parts
from cam.reading.gcode import LANGUAGES, ProgramError
from cam.surface.stock_grid import StockGrid
from machines.preflight.rules import describe_slow_link
from machines.profile import MachineProfile
from optics.heightfield import Heightfield
from phrases.phrase import Phrase
from service.errors import FailedError
from service.job import arrays
from service.job.files import (
    FACED_STOCK,
    HEIGHTFIELD,
    LAST_STOCK,
    WrittenProgram,
    program_name,
    read_chunks,
    stock_name,
    write_program,
)
from service.job.planning.fit import check_ball_fit, require_flutes
from service.job.planning.lens_facts import measure_lens
from service.job.spec.envelope import require_envelope
from service.job.spec.resolve import (
    ResolvedJob,
    cam_passes_of,
    cam_stock_of,
    digits_of,
    number_tools,
    post_of,
    setup_of,
    tool_key,
)
from service.job.stages.context import StageContext

Check = TypeVar("Check", PassCheck, AroundCheck)

CHIPS_WITHIN = 0.97
"""Share of the cutting time whose chips must be within the material's band; less is worth a warning."""
REACHED_SHARE = 0.9
"""Share of the written feed from which the mill counts as reaching it."""
_COARSE_STEP_MM = 0.002  # step in heights from which a picture shows it
_CELLS_ACROSS = 2200  # of the whole-part removal grid: 0.05 mm cells on 110 mm


def run_pass(context: StageContext) -> None:
    """Write one program, then check it from its text; return its row of report `passes` and the stock it leaves.

    FailedError with the faults if it does not pass; the folder, and the program with it, are then removed.
    """
    heightfield = context.receive(HEIGHTFIELD, arrays.load_heightfield)
    spec, stock = cam_passes_of(context.spec)[context.number - 1], cam_stock_of(context.spec)
    spec = replace(spec, max_rate_mm_per_min=context.machine.max_rate_mm_per_min)
    if context.number == 1:
        stock_top = (
            first_stock(stock) if context.spec.stock.face is None else context.receive(FACED_STOCK, arrays.load_stock)
        )
    else:
        stock_top = context.receive(stock_name(context.number - 1), arrays.load_stock)
    written = _write(context, spec, heightfield, stock_top)
    verdict = _check(context, [part.file for part in written], spec, heightfield, stock_top)
    rest_follows = any(later.where == "rest" for later in context.spec.passes[context.number :])
    notes = () if rest_follows else verdict.notes  # the rest pass removes what is left here
    of_finish = (*notes, *_of_coarse_steps(context.job, spec), *_of_parts(written)) if spec.finishes else ()
    for sentence in (
        *of_finish,
        *_of_starving(context.machine, spec, verdict),
        *_of_chips(spec, verdict),
    ):
        context.note("passes", Phrase("{file}: {sentence}", file=written[0].file, sentence=sentence))
    row = {
        "file": written[0].file,
        **verdict.as_report(),
        **describe_parts(written),
        "settings": context.spec.passes[context.number - 1].model_dump(),
    }
    context.report["passes"] = [row]
    if context.number < len(context.spec.passes):
        context.hand_over(stock_name(context.number), verdict.stock_top, arrays.stock_bytes)
    elif context.spec.goes_on_after_passes:
        context.hand_over(LAST_STOCK, verdict.stock_top, arrays.stock_bytes)


def run_fit(context: StageContext) -> None:
    """Check everything about the tools of all programs and the travel that can be known before the first block."""
    heightfield = context.receive(HEIGHTFIELD, arrays.load_heightfield)
    passes = cam_passes_of(context.spec)
    with context.watch.stage("fit"):
        form, depth_mm = LensForm.of(heightfield), -float(heightfield.z_mm.min())
        lowest_mm = [form.lowest_tip_mm(one.radius_mm) for one in passes]
        require_envelope(context.spec, context.machine, depth_mm=depth_mm, lowest_mm=lowest_mm)
        require_flutes(heightfield, passes)
        unfit = check_ball_fit(measure_lens(heightfield), passes, shaped_for_mm=context.spec.lens_radius_mm)
        if unfit:
            context.note("passes", unfit)
        if not passes[-1].finishes:
            context.note(
                "passes",
                Phrase(
                    "the last pass leaves {left_mm:g} mm of stock: no pass makes the optical surface",
                    left_mm=passes[-1].stock_to_leave_mm,
                ),
            )


def first_stock(stock: Stock) -> StockGrid:
    """Return the uncut block at the resolution of the whole-part simulation."""
    longest_mm = max(stock.width_mm, stock.height_mm) + 2 * stock.margin_mm
    return StockGrid.block(stock, max(0.005, longest_mm / _CELLS_ACROSS))


def simulate(
    paths: Sequence[Path],
    spec: PassSpec,
    heightfield: Heightfield,
    stock: Stock,
    stock_top: StockGrid,
    machine: MachineProfile,
    on_progress: Callable[[float], None] | None = None,
) -> PassCheck:
    """Read a pass's programs back, one after the other, and simulate what they remove from stock_top."""
    return check_program(
        read_chunks(paths[0]),
        further=map(read_chunks, paths[1:]),
        heightfield=heightfield,
        spec=spec,
        stock=stock,
        stock_top=stock_top,
        kinematics=Kinematics.of(machine),
        safe_z_mm=machine.safe_z_mm,
        language=LANGUAGES[machine.dialect],
        digit_mm=digits_of(machine).z_mm,
        total_bytes=sum(path.stat().st_size for path in paths),
        on_progress=on_progress,
    )


def _step_mm(machine: MachineProfile) -> float:
    return machine.step_mm if machine.whole_steps else 0.0


def _of_parts(written: Sequence[WrittenProgram]) -> Iterator[Phrase]:
    if len(written) > 1:
        yield Phrase(
            "the pass is split into {count} programs up to {file}; each goes on in the track of the one before, "
            "{entries} entries more at the most: do not change tool or zero between them",
            count=len(written),
            file=written[-1].file,
            entries=len(written) - 1,
        )


def _of_coarse_steps(job: ResolvedJob, spec: PassSpec) -> Iterator[Phrase]:
    """Yield warnings about the effect of the raster of heights on the light, if it is visible.

    Neighbouring rows are off by 0.1 to 0.2 of a step rms. Where rows lie closer than the width of a groove of that
    depth, the deepest ones make the surface, with slopes of 0.4 sqrt(2 sigma / R), as on simulated surfaces.
    """
    digits = digits_of(job.machine)
    if digits.z_mm < _COARSE_STEP_MM or job.spec.finish.finishes:
        return
    slope = 0.4 * math.sqrt(2 * 0.2 * digits.z_mm / spec.radius_mm)
    yield Phrase(
        "the mill's steps in height will blur the picture; finer positions or a larger ball show more (steps of "
        "{step_mm:g} mm tilt the surface by about {slope_um_per_mm:.0f} µm per mm ({slope_um_per_mm:.0f} mrad) from "
        "row to row)",
        step_mm=digits.z_mm,
        slope_um_per_mm=1000 * slope,
    )


def _of_starving(machine: MachineProfile, spec: PassSpec, verdict: PassCheck) -> Iterator[Phrase]:
    """Yield the feed that the link can carry, if the mill waits for lines. Only for RML-1, whose time the pre-flight
    just estimates; for other dialects the pre-flight itself warns.
    """
    if machine.dialect == RML.name and (
        words := describe_slow_link(
            machine.lines_per_s,
            None,
            feed_mm_per_min=spec.feed_mm_per_min,
            lines=verdict.lines,
            path_length_mm=verdict.path_length_mm,
            time_s=verdict.time_s,
            starved_s=verdict.starved_s,
        )
    ):
        yield words


def _of_chips(spec: PassSpec, verdict: PassCheck) -> Iterator[Phrase]:
    """Yield how much of the time chips are thinner or thicker than the material's band, where, and what helps."""
    chips = verdict.chips
    if chips is None or chips.share >= CHIPS_WITHIN:
        return
    (below_s, _, above_s), whole_s = chips.seconds, sum(chips.seconds)
    least_mm, most_mm = spec.chip_mm
    teeth_per_min = spec.flutes * spec.spindle_rpm
    if below_s >= above_s:
        reaches = chips.thinnest_mm > REACHED_SHARE * chips.written_mm
        yield Phrase(
            "chips are too thin for {percent:.0f} % of the cutting time: edges rub and heat ({thin_um:.1f} µm per "
            "tooth with {flutes} flutes at {spindle_rpm:g} rpm, the band begins at {least_um:g}; the longest stretch "
            "ends in line {line} at X{x_mm:.2f} Y{y_mm:.2f}); {feed}; use {rpm:.0f} rpm or, if the spindle "
            "cannot turn so slowly, {cure}",
            percent=100 * below_s / whole_s,
            thin_um=1000 * chips.thinnest_mm,
            flutes=spec.flutes,
            spindle_rpm=spec.spindle_rpm,
            least_um=1000 * least_mm,
            line=chips.line,
            x_mm=chips.x_mm,
            y_mm=chips.y_mm,
            feed=Phrase("F{feed_mm_per_min:.0f} is too low there", feed_mm_per_min=chips.written_mm * teeth_per_min)
            if reaches
            else Phrase(
                "of F{feed_mm_per_min:.0f} the mill reaches F{reached_mm_per_min:.0f} there, because it speeds up, "
                "brakes or waits for lines",
                feed_mm_per_min=chips.written_mm * teeth_per_min,
                reached_mm_per_min=chips.thinnest_mm * teeth_per_min,
            ),
            rpm=spec.spindle_rpm * chips.thinnest_mm / least_mm,
            cure=Phrase("fewer flutes or a higher feed") if reaches else Phrase("fewer flutes"),
        )
    else:
        yield Phrase(
            "chips are too thick for {percent:.0f} % of the cutting time: edges may break (the band ends at "
            "{most_um:g} µm per tooth, with {flutes} flutes at {spindle_rpm:g} rpm F{most_mm_per_min:.0f}); lower the "
            "feed, or turn faster",
            percent=100 * above_s / whole_s,
            most_um=1000 * most_mm,
            flutes=spec.flutes,
            spindle_rpm=spec.spindle_rpm,
            most_mm_per_min=most_mm * teeth_per_min,
        )


def part_limits_of(machine: MachineProfile) -> PartLimits:
    megabytes, hours = machine.most_program_mb, machine.most_program_hours
    return PartLimits(
        most_bytes=math.inf if megabytes is None else 1e6 * megabytes,
        most_s=math.inf if hours is None else 3600 * hours,
        rapid_mm_per_min=min(machine.max_rate_mm_per_min),
    )


def _write(
    context: StageContext, spec: PassSpec, heightfield: Heightfield, stock_top: StockGrid
) -> list[WrittenProgram]:
    """Return the programs of the pass: one, or its parts."""
    machine = context.machine
    post, row = post_of(machine), context.spec.passes[context.number - 1]
    setup = setup_of(machine, tool=number_tools(context.spec)[tool_key(row)])
    is_first = context.number == 1 and context.spec.stock.face is None
    with context.watch.stage(f"write pass {context.number} {spec.name}") as on_progress:
        parts = generate_parts(
            heightfield,
            spec,
            cam_stock_of(context.spec),
            stock_top=stock_top,
            post=post,
            safe_z_mm=machine.safe_z_mm,
            limits=part_limits_of(machine),
            step_mm=_step_mm(machine),
            shaped=context.spec.finish.finishes,
            number=context.number,
            setup=setup if is_first else setup.without_warm_up(),
            trace=trace_of(context.job) if is_first else (),
            on_progress=on_progress,
        )
        return write_parts(context.folder, partial(program_name, context.number, spec.name, post.suffix), parts)


def write_parts(
    folder: Path, name_of: Callable[[int | None], str], parts: Iterable[Iterable[bytes]]
) -> list[WrittenProgram]:
    """Return the programs of a pass; name_of: their files, by the number of the part, or None if there is only one."""
    names = map(name_of, count(1))
    written = [write_program(folder / name, chunks) for name, chunks in zip(names, parts, strict=False)]
    if len(written) == 1:
        (folder / written[0].file).rename(folder / name_of(None))
        return [replace(written[0], file=name_of(None))]
    return written


def describe_parts(written: Sequence[WrittenProgram]) -> dict[str, Any]:
    """Return the figures of a pass's program files for its row of the report."""
    return {
        **asdict(written[0]),
        **({"parts": [asdict(part) for part in written]} if len(written) > 1 else {}),
    }


def require_passed(called: str, check: Callable[[], Check]) -> Check:
    """Return the verdict of a check; FailedError if it finds faults, or the text cannot be read."""
    try:
        verdict = check()
    except ProgramError as error:
        raise FailedError(Phrase("{name}: {cause}", name=called, cause=str(error))) from error
    if not verdict.ok:
        raise FailedError(*(Phrase("{name}: {fault}", name=called, fault=fault) for fault in verdict.faults))
    return verdict


def trace_of(job: ResolvedJob) -> tuple[ToolPath, ...]:
    """Return the path around block and lens at the safe height, for a job's first program; empty if not requested."""
    spec, machine = job.spec, job.machine
    if not machine.trace_outline:
        return ()
    feed = min(TRACE_FEED_MM_PER_MIN, *machine.max_rate_mm_per_min[:2])
    outline = spec.optics.outline_mm or ()
    return trace_paths(cam_stock_of(spec), outline, safe_z_mm=machine.safe_z_mm, feed_mm_per_min=feed)


def _check(
    context: StageContext, files: list[str], spec: PassSpec, heightfield: Heightfield, stock_top: StockGrid
) -> PassCheck:
    stock, machine = cam_stock_of(context.spec), context.machine
    called = (
        files[0]
        if len(files) == 1
        else Phrase("{first} to {last}, lines numbered consecutively", first=files[0], last=files[-1])
    )
    paths = [context.folder / file for file in files]
    with context.watch.stage(f"check pass {context.number} {spec.name}") as on_progress:
        return require_passed(
            called, lambda: simulate(paths, spec, heightfield, stock, stock_top, machine, on_progress)
        )
