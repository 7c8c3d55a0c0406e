"""Stages around the passes of the lens: before them the stock's top is faced; after them witness marks are milled and
the lens is cut out.

Their programs are written, read back and simulated like every pass; the stock is handed from one to the next.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cam.around.check import AroundCheck, CheckedMill, check_cut_out, check_facing, check_witness
from cam.around.paths import find_highest_along, make_cut_out_paths, make_facing_paths, make_witness_paths
from cam.around.specs import CutOut, Facing, WitnessCut
from cam.duration import Kinematics
from cam.moves import Path as ToolPath
from cam.parts import PassFrame, programs
from cam.posts.remarks import describe_around
from cam.reading.gcode import LANGUAGES
from cam.surface.stock_grid import StockGrid
from machines.profile import MachineProfile
from optics.witness import VISIBLE_SLOPE_RAD, NoMarksError
from optics.witness_light import WALL_MM
from phrases.phrase import Phrase
from service.job import arrays
from service.job.files import CUT_OUT, FACE, FACED_STOCK, LAST_STOCK, WITNESS, WrittenProgram, program_name, read_chunks
from service.job.planning.around import cut_out_ways, lens_corners
from service.job.planning.witness import plan_witness
from service.job.spec.model import JobSpec
from service.job.spec.resolve import (
    ResolvedJob,
    cam_stock_of,
    cut_out_of,
    facing_task_of,
    number_tools,
    post_of,
    setup_of,
    tool_key,
)
from service.job.stages.context import StageContext
from service.job.stages.programs import (
    describe_parts,
    first_stock,
    part_limits_of,
    require_passed,
    trace_of,
    write_parts,
)

AroundTask = Facing | WitnessCut | CutOut

_SLENDER = 6.0  # depth over diameter from which a flat end mill in a slot bends too far


def run_facing(context: StageContext) -> None:
    """Write the program that faces the stock; return its row of report `around` and the stock that it leaves."""
    facing, stock, machine = facing_task_of(context.spec), cam_stock_of(context.spec), context.machine
    assert facing is not None and context.spec.stock.face is not None  # by the plan of stages
    paths = make_facing_paths(facing, stock, safe_z_mm=machine.safe_z_mm)
    written = write_around(context, 0, FACE, paths, facing, trace=trace_of(context.job))
    verdict = _check(context, written, facing, raw_stock(context.spec))
    context.report["around"] = {FACE: row_of(written, verdict, {"name": FACE, **context.spec.stock.face.model_dump()})}
    context.hand_over(FACED_STOCK, verdict.stock_top, arrays.stock_bytes)


def run_witness(context: StageContext) -> None:
    """Write the program that mills the witness marks; return its row of report `around`, and the marks in `witness`. No
    program if no marks can be made.
    """
    try:
        planned = plan_witness(context.job)
    except NoMarksError as error:
        context.report["witness"] = {"obstacle": error.obstacle}
        return
    task, top = planned.cut, context.receive(LAST_STOCK, arrays.load_stock)
    left, right, front, back = task.box_mm
    highest_mm = top.highest_mm(left, right, front, back)
    assert highest_mm is not None  # the strip lies in the block
    paths = make_witness_paths(task, top_mm=highest_mm, safe_z_mm=context.machine.safe_z_mm)
    written = write_around(context, len(context.spec.passes) + 1, WITNESS, paths, task)
    verdict = _check(context, written, task, top)
    figures = ("radius_mm", "step_down_mm", "feed_mm_per_min", "plunge_mm_per_min", "spindle_rpm")
    settings = {"name": WITNESS, "tool": "ball", **{name: getattr(task, name) for name in figures}}
    context.report["around"] = {WITNESS: row_of(written, verdict, settings)}
    context.report["witness"] = {
        "side": planned.side,
        "box_mm": list(task.box_mm),
        "depth_mm": -task.lowest_mm,
        "visible_slope_rad": VISIBLE_SLOPE_RAD,
        "wall_mm": WALL_MM if context.spec.optics.surface == "lens" else None,  # no light goes through a mirror
        "marks": [
            {"share": mark.share, "period_mm": mark.period_mm, "periods": mark.periods, "height_mm": mark.amplitude_mm}
            for mark in planned.strip.marks
        ],
    }


def run_cut_out(context: StageContext) -> None:
    """Write the program that cuts the lens out; return its row of report `around`."""
    task, stock, machine = cut_out_of(context.spec), cam_stock_of(context.spec), context.machine
    assert task is not None and context.spec.stock.cut_out is not None  # by the plan of stages
    top = context.receive(LAST_STOCK, arrays.load_stock)
    loop = cut_out_ways(context.job, task)[1]
    top_mm = find_highest_along(loop, task.radius_mm, top)
    paths = make_cut_out_paths(task, stock, loop, top_mm=top_mm, safe_z_mm=machine.safe_z_mm)
    written = write_around(context, len(context.spec.passes) + context.spec.finish.witnessed + 1, CUT_OUT, paths, task)
    verdict = _check(context, written, task, top)
    depth_mm, diameter_mm = stock.thickness_mm + task.through_mm, 2 * task.radius_mm
    if depth_mm > _SLENDER * diameter_mm:
        context.note(
            "passes",
            Phrase(
                "{file}: a flat end mill of {diameter_mm:g} mm diameter has to reach {depth_mm:g} mm deep in a slot, "
                "{times:.0f} times its diameter; a thicker one (stock.cut_out.radius_mm, with its margin) or a thinner "
                "block bends and breaks less",
                file=written[0].file,
                diameter_mm=diameter_mm,
                depth_mm=depth_mm,
                times=depth_mm / diameter_mm,
            ),
        )
    settings = {"name": CUT_OUT, "tool": "flat", **context.spec.stock.cut_out.model_dump()}
    context.report["around"] = {CUT_OUT: row_of(written, verdict, settings)}


def checked_mill_of(machine: MachineProfile) -> CheckedMill:
    digits = post_of(machine).digits
    return CheckedMill(
        kinematics=Kinematics.of(machine),
        safe_z_mm=machine.safe_z_mm,
        language=LANGUAGES[machine.dialect],
        digit_mm=digits.z_mm,
        xy_digit_mm=digits.xy_mm,
    )


def simulate(paths: Sequence[Path], task: AroundTask, job: ResolvedJob, stock_top: StockGrid) -> AroundCheck:
    """Read the programs back, one after the other, and simulate what they remove from stock_top."""
    stock, mill, texts = cam_stock_of(job.spec), checked_mill_of(job.machine), map(read_chunks, paths)
    if isinstance(task, Facing):
        return check_facing(texts, task, stock=stock, stock_top=stock_top, mill=mill)
    if isinstance(task, WitnessCut):
        return check_witness(texts, task, stock=stock, stock_top=stock_top, mill=mill, corners_mm=lens_corners(job))
    corners, loop = cut_out_ways(job, task)
    return check_cut_out(texts, task, stock=stock, stock_top=stock_top, mill=mill, corners_mm=corners, loop_mm=loop)


def raw_stock(spec: JobSpec) -> StockGrid:
    """Return the block before the first program, including the stock that will be faced off."""
    block = first_stock(cam_stock_of(spec))
    if spec.stock.face is None:
        return block
    top_mm = np.full(block.top_mm.shape, spec.stock.face.above_mm)
    return StockGrid(x0_mm=block.x0_mm, y0_mm=block.y0_mm, cell_mm=block.cell_mm, top_mm=top_mm)


def write_around(
    context: StageContext,
    number: int,
    name: str,
    paths: Iterable[ToolPath],
    task: AroundTask,
    *,
    trace: tuple[ToolPath, ...] = (),
) -> list[WrittenProgram]:
    """Write a program around the passes; one, or its parts."""
    stock, machine = cam_stock_of(context.spec), context.machine
    post, setup = post_of(machine), setup_of(machine, tool=_tool_number(context.spec, task))
    frame = PassFrame(
        remarks=describe_around(task, stock),
        rpm=task.spindle_rpm,
        plunge_mm_per_min=task.plunge_mm_per_min,
        safe_z_mm=machine.safe_z_mm,
        aperture_mm=(stock.width_mm, stock.height_mm),
        number=number,
        setup=setup if isinstance(task, Facing) else setup.without_warm_up(),
        trace=trace,
    )
    with context.watch.stage(f"write {name}"):
        parts = programs(paths, post, frame, part_limits_of(machine))
        return write_parts(context.folder, partial(program_name, number, name, post.suffix), parts)


def _tool_number(spec: JobSpec, task: AroundTask) -> int:
    tools = number_tools(spec)
    around = spec.stock.face if isinstance(task, Facing) else spec.stock.cut_out
    row = spec.passes[-1] if isinstance(task, WitnessCut) else around
    assert row is not None
    return tools[tool_key(row)]


def _check(context: StageContext, written: list[WrittenProgram], task: AroundTask, top: StockGrid) -> AroundCheck:
    called = written[0].file
    with context.watch.stage(f"check {called}"):
        paths = [context.folder / part.file for part in written]
        return require_passed(called, lambda: simulate(paths, task, context.job, top))


def row_of(written: list[WrittenProgram], verdict: AroundCheck, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the row of report `around`."""
    figures = ("moves", "path_length_mm", "time_s", "entries", "max_engagement_mm", "gouge_um", "left_um", "bounds")
    return {
        "file": written[0].file,
        "ok": verdict.ok,
        "faults": list(verdict.faults),
        **{name: getattr(verdict, name) for name in figures},
        **({} if verdict.clear_um is None else {"clear_um": verdict.clear_um}),
        **({"tabs": [asdict(tab) for tab in verdict.tabs]} if verdict.tabs else {}),
        **describe_parts(written),
        "settings": settings,
    }
