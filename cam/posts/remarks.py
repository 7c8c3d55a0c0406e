"""Remarks for the operator at the head of a program: cutter, block and zero, one line each."""

from __future__ import annotations

from cam.around.specs import CutOut, Facing, WitnessCut
from cam.passes import PassSpec, Stock
from cam.posts.post import number as n

_CORNER = "X0 Y0: lower left corner of the lens aperture"


def describe_pass(spec: PassSpec, stock: Stock) -> tuple[str, ...]:
    block = f"{n(stock.width_mm + 2 * stock.margin_mm)} x {n(stock.height_mm + 2 * stock.margin_mm)}"
    return (
        f"pass {spec.name}: {name_cutter(spec)} radius {n(spec.radius_mm)} mm, pitch {n(spec.pitch_mm)} mm",
        f"leaves {n(spec.stock_to_leave_mm)} mm, step-down {n(spec.step_down_mm)} mm",
        describe_tool(spec),
        f"block {block} x {n(stock.thickness_mm)} mm, margin {n(stock.margin_mm)} mm",
        f"{_CORNER}, Z0: top of the block, mm",
    )


def describe_tool(spec: PassSpec) -> str:
    """Describe the tool by its feed per tooth and what the pass states: number, name, flutes, stick-out."""
    number = f"T{spec.tool_number} " if spec.tool_number else ""
    out = f", stick-out {n(spec.stick_out_mm)} mm" if spec.stick_out_mm else ""
    chip_mm = spec.feed_mm_per_min / (spec.spindle_rpm * spec.flutes)
    name = f"{spec.tool_name}, " if spec.tool_name else ""
    return f"tool {number}{name}{spec.flutes} flute{'s' * (spec.flutes > 1)}{out}, {n(chip_mm)} mm per tooth"


def name_cutter(spec: PassSpec) -> str:
    """Return the name of the cutter, with the radius of its corner if its shape does not imply it."""
    corner_mm = spec.shape.corner_mm(spec.radius_mm)
    return f"{spec.shape.name} end mill" + ("" if spec.is_ball or not corner_mm else f" corner {n(corner_mm)} mm")


def describe_around(task: Facing | WitnessCut | CutOut, stock: Stock) -> tuple[str, ...]:
    """Return the remarks of a program that mills around the lens."""
    if isinstance(task, Facing):
        return (
            f"face: {task.shape} end mill radius {task.radius_mm:g} mm, from Z{task.above_mm:g} down to Z0",
            f"{_CORNER}, Z0: top of the faced block, mm",
        )
    if isinstance(task, WitnessCut):
        left, right, front, back = task.box_mm
        return (
            f"witness marks: ball end mill radius {task.radius_mm:g} mm, the ball of the pass before",
            f"strip X{left:.2f} to X{right:.2f}, Y{front:.2f} to Y{back:.2f}, down to Z{task.lowest_mm:g}",
            f"{_CORNER}, Z0: top of the block, mm",
        )
    return (
        f"cut-out: flat end mill radius {task.radius_mm:g} mm, {task.tabs} tabs {task.tab_height_mm:g} mm high",
        f"down to Z{-stock.thickness_mm - task.through_mm:g}, step-down {task.step_down_mm:g} mm",
        f"{_CORNER}, Z0: top of the block, mm",
    )


def describe_part(part: int) -> str:
    """Return the remark of a later part of a program that is too large for its control."""
    return f"part {part}: goes on where part {part - 1} has ended"
