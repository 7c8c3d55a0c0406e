"""What happens around the passes, in sentences for the setup sheet: facing, trace, warm-up, coolant, corners, tabs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cam.posts.dialects import POSTS
from cam.posts.post import HIGH_PRECISION_WORDS, Post
from phrases.phrase import Phrase
from service.job.files import table
from service.wording import duration, number

_COOLANTS = {"air": Phrase("air blast"), "mist": Phrase("mist"), "flood": Phrase("coolant")}
_END_MILLS = {
    "flat": Phrase("a flat end mill"),
    "ball": Phrase("a ball end mill"),
    "bull-nose": Phrase("a bull-nose end mill"),
}


def around_sentences(spec: Mapping[str, Any], report: Mapping[str, Any]) -> list[Phrase]:
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


def explain_zero_before_facing(spec: Mapping[str, Any]) -> Phrase | None:
    """Return how Z0 is found while the raw top still stands above it; None where nothing is faced."""
    above_mm = table(table(spec.get("stock")).get("face")).get("above_mm")
    if above_mm is None:
        return None
    return Phrase(
        "Before the facing, touch the raw top and set Z to {above_mm} there, not to 0: Z0 lies that far below. After "
        "it, set Z0 on the faced top with each new tool.",
        above_mm=number(above_mm, 3),
    )


def _of_facing(face: Mapping[str, Any]) -> Iterator[Phrase]:
    if face:
        shape = str(face.get("tool", "flat"))
        yield Phrase(
            "The first program faces the whole top with {tool} and takes up to {above_mm} mm off. It comes down and "
            "turns beside the block, down to Z0: nothing may stand there higher than 1 mm below Z0, and no clamp may "
            "lie on the top.",
            tool=_END_MILLS.get(shape, Phrase("a {shape} end mill", shape=shape)),
            above_mm=number(face.get("above_mm"), 3),
        )


def _of_begin(machine: Mapping[str, Any]) -> Iterator[Phrase]:
    if machine.get("trace_outline"):
        post = POSTS.get(str(machine.get("dialect")))
        turning = post is not None and post.traces_with_spindle_on
        yield Phrase(
            "Before its first cut the first program goes once around the block and once around the lens at Z "
            "{safe_z_mm} mm, {spindle}: check that the block lies under it, and stop the mill if it does not.",
            safe_z_mm=number(machine.get("safe_z_mm")),
            spindle=Phrase("the spindle turning") if turning else Phrase("the spindle off"),
        )
    if machine.get("warm_up_s"):
        yield Phrase(
            "Then the spindle warms up in four steps of speed within {duration}, in the first program only.",
            duration=duration(machine["warm_up_s"]),
        )


def _of_every_program(machine: Mapping[str, Any]) -> Iterator[Phrase]:
    coolant, post = machine.get("coolant", "none"), POSTS.get(str(machine.get("dialect")))
    if (offset := machine.get("work_offset", 1)) != 1:
        name = post.name_offset(offset) if isinstance(post, Post) else f"G{53 + offset}"
        yield Phrase("Every program works in offset {name}: set X0 Y0 and Z0 there, not in the first one.", name=name)
    word = post.coolant.get(str(coolant)) if post else None
    if word:
        yield Phrase(
            "Every program switches the {coolant} on by {word} before its first cut and off by M9 after its last: "
            "connect it to that output, and try it from the console.",
            coolant=_COOLANTS[str(coolant)],
            word=word,
        )
    if tolerance_mm := machine.get("blend_tolerance_mm"):
        within_mm = number(tolerance_mm, 4)
        yield Phrase("Corners are rounded by the control within {within_mm} mm (G64).", within_mm=within_mm)
    elif tolerance_mm is not None:
        yield Phrase("The control stops exactly at every point (G61.1): this is slow and leaves marks where it stops.")
    if (mode := machine.get("high_precision", "none")) in HIGH_PRECISION_WORDS:
        on, off = HIGH_PRECISION_WORDS[str(mode)]
        yield Phrase(
            "Programs run in the control's high-precision mode: {on} at their begin, {off} at their end.",
            on=on,
            off=off,
        )


def _of_cut_out(cut_out: Mapping[str, Any], stock: Mapping[str, Any], made: Mapping[str, Any]) -> Iterator[Phrase]:
    if not cut_out:
        return
    cut = Phrase(
        "The last program cuts the lens out along its outline with a flat end mill {diameter_mm:g} mm in diameter",
        diameter_mm=2 * cut_out["radius_mm"],
    )
    if (clear_um := made.get("clear_um")) is not None:
        cut = Phrase("{cut}, {clear_um} µm clear of it", cut=cut, clear_um=number(clear_um, 0))
    cut = Phrase(
        "{cut}, through the block of {thickness_mm} mm", cut=cut, thickness_mm=number(stock.get("thickness_mm"))
    )
    if through_mm := cut_out.get("through_mm"):
        cut = Phrase(
            "{cut}, {through_mm} mm into what lies below it: put a board there",
            cut=cut,
            through_mm=number(through_mm, 2),
        )
    if not (tabs := cut_out.get("tabs")):
        yield Phrase("{cut}; no tab holds it: it must be held from below.", cut=cut)
        return
    yield Phrase(
        "{cut}; {count} tabs {height_mm} mm high hold it: saw them through and file them flush.",
        cut=cut,
        count=tabs,
        height_mm=number(cut_out.get("tab_height_mm"), 2),
    )
