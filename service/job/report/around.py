"""What happens around the passes, in sentences for the setup sheet: facing, trace, warm-up, coolant, corners, tabs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cam.posts.dialects import POSTS
from cam.posts.setup import HIGH_PRECISION_WORDS
from service.job.finite_json import table
from service.wording import duration, number

_COOLANTS = {"air": "air blast", "mist": "mist", "flood": "coolant"}


def around_sentences(spec: Mapping[str, Any], report: Mapping[str, Any]) -> list[str]:
    """Return one sentence each, in the order in which it happens; none for a job without all that.

    spec : with the whole figures of the mill under `machine`
    """
    machine, stock = table(spec.get("machine")), table(spec.get("stock"))
    around = table(report.get("around"))
    return [
        *_of_facing(table(stock.get("face"))),
        *_of_begin(machine),
        *_of_every_program(machine),
        *_of_cut_out(table(stock.get("cut_out")), stock, table(around.get("cut-out"))),
    ]


def explain_zero_before_facing(spec: Mapping[str, Any]) -> str | None:
    """Return how Z0 is found while the raw top still stands above it; None where nothing is faced."""
    above_mm = table(table(spec.get("stock")).get("face")).get("above_mm")
    if above_mm is None:
        return None
    return (
        f"Before the facing, touch the raw top and set Z to {number(above_mm, 3)} there, not to 0: Z0 lies that far "
        "below. After it, set Z0 on the faced top with each new tool."
    )


def _of_facing(face: Mapping[str, Any]) -> Iterator[str]:
    if face:
        yield (
            f"The first program faces the whole top with a {face.get('tool', 'flat')} end mill and takes up to "
            f"{number(face.get('above_mm'), 3)} mm off. It comes down and turns beside the block, down to Z0: nothing "
            "may stand there higher than 1 mm below Z0, and no clamp may lie on the top."
        )


def _of_begin(machine: Mapping[str, Any]) -> Iterator[str]:
    if machine.get("trace_outline"):
        post = POSTS.get(str(machine.get("dialect")))
        turning = post is not None and post.traces_with_spindle_on
        yield (
            f"Before its first cut the first program goes once around the block and once around the lens at "
            f"Z {number(machine.get('safe_z_mm'))} mm, {'the spindle turning' if turning else 'the spindle off'}: look "
            "whether the block lies under it, and stop it if not."
        )
    if machine.get("warm_up_s"):
        yield (
            f"Then the spindle warms up in four steps of speed within {duration(machine['warm_up_s'])}, in the first "
            "program only."
        )


def _of_every_program(machine: Mapping[str, Any]) -> Iterator[str]:
    coolant, post = machine.get("coolant", "none"), POSTS.get(str(machine.get("dialect")))
    if (offset := machine.get("work_offset", 1)) != 1:
        name = f"G15 H{offset}" if machine.get("dialect") == "okuma" else f"G{53 + offset}"
        yield f"Every program works in offset {name}: set X0 Y0 and Z0 there, not in the first one."
    word = post.coolant.get(str(coolant)) if post else None
    if word:
        yield (
            f"Every program switches the {_COOLANTS[str(coolant)]} on by {word} before its first cut and off by M9 "
            "after its last: connect it to that output, and try it from the console."
        )
    if machine.get("blend_tolerance_mm") is not None:
        tolerance_mm = machine["blend_tolerance_mm"]
        yield (
            f"Corners are rounded by the control within {number(tolerance_mm, 4)} mm (G64)."
            if tolerance_mm
            else "The control stops exactly at every point (G61.1): slow, and with marks where it stands."
        )
    if (mode := machine.get("high_precision", "none")) in HIGH_PRECISION_WORDS:
        on, off = HIGH_PRECISION_WORDS[str(mode)]
        yield f"Programs run in the control's high-precision mode: {on} at their begin, {off} at their end."


def _of_cut_out(cut_out: Mapping[str, Any], stock: Mapping[str, Any], made: Mapping[str, Any]) -> Iterator[str]:
    if not cut_out:
        return
    through_mm, tabs = cut_out.get("through_mm") or 0.0, cut_out.get("tabs") or 0
    board = f", {number(through_mm, 2)} mm into what lies below it: put a board there" if through_mm else ""
    held = (
        f"{tabs} tabs {number(cut_out.get('tab_height_mm'), 2)} mm high hold it: saw them through and file them flush"
        if tabs
        else "no tab holds it: it must be held from below"
    )
    clear_um = made.get("clear_um")
    kept = f", {number(clear_um, 0)} µm clear of it" if clear_um is not None else ""
    yield (
        f"The last program cuts the lens out along its outline with a flat end mill {2 * cut_out['radius_mm']:g} mm in "
        f"diameter{kept}, through the block of {number(stock.get('thickness_mm'))} mm{board}; {held}."
    )
