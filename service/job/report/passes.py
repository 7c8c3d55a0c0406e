"""The programs on the setup sheet: sentences about the work around the passes, and the findings of each check in
numbers, with a row for each question and a column for each pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import ceil, log
from typing import Any

from cam.materials import MATERIALS
from cam.posts.dialects import POSTS
from cam.posts.post import HIGH_PRECISION_WORDS, MM_PER_INCH, Post
from cam.rows.entries import RAMP_DEG
from phrases.phrase import Phrase, join
from service.job.files import WITNESS, table
from service.wording import MISSING, duration, number, whole

_COOLANTS = {"air": Phrase("air blast"), "mist": Phrase("mist"), "flood": Phrase("coolant")}
_END_MILLS = {
    "flat": Phrase("a flat end mill"),
    "ball": Phrase("a ball end mill"),
    "bull-nose": Phrase("a bull-nose end mill"),
}

_RESTARTS = {"layer": Phrase("a layer"), "entry": Phrase("an entry"), "row": Phrase("a row")}

Row = Mapping[str, Any]
Cells = tuple[Phrase, str, list[str]]

_SCRATCH_MM = 0.5  # shorter slots are not mentioned


def around_sentences(spec: Mapping[str, Any], report: Mapping[str, Any]) -> list[Phrase]:
    """Return a sentence for each of these steps, in the order in which they happen; none for a job without any.

    spec : with the whole figures of the mill under `machine`
    """
    machine, stock = table(spec.get("machine")), table(spec.get("stock"))
    around = table(report.get("around"))
    return [
        *_describe_facing(table(stock.get("face"))),
        *_of_begin(machine),
        *_of_every_program(machine),
        *_of_cut_out(table(stock.get("cut_out")), stock, table(around.get("cut-out"))),
        *_of_one_program(table(report.get("one_program"))),
    ]


def explain_zero_before_facing(spec: Mapping[str, Any]) -> Phrase | None:
    """Return how Z0 is found while the raw top still stands above it; None if nothing is faced."""
    above_mm = table(table(spec.get("stock")).get("face")).get("above_mm")
    if above_mm is None:
        return None
    if table(spec.get("machine")).get("tool_change"):
        return Phrase(
            "Before the facing, touch the raw top with a tool whose length the control knows, and set Z to {above_mm} "
            "there, not to 0: Z0 lies that far below.",
            above_mm=number(above_mm, 3),
        )
    return Phrase(
        "Before the facing, touch the raw top and set Z to {above_mm} there, not to 0: Z0 lies that far below. After "
        "it, set Z0 on the faced top with each new tool.",
        above_mm=number(above_mm, 3),
    )


def _describe_facing(face: Mapping[str, Any]) -> Iterator[Phrase]:
    if face:
        shape = str(face.get("tool", "flat"))
        yield Phrase(
            "The first program faces the whole top with {tool} and takes up to {above_mm} mm off. It comes down and "
            "turns beside the block, down to Z0: nothing may stand there higher than 1 mm below Z0, and no clamp may "
            "lie on the top.",
            tool=_END_MILLS.get(shape, Phrase("a {shape} end mill", shape=shape)),
            above_mm=number(face.get("above_mm"), 3),
        )


def _of_one_program(whole: Mapping[str, Any]) -> Iterator[Phrase]:
    if whole:
        changes = [
            Phrase("T{tool} in line {line} for {file}", tool=one["tool"], line=one["line"], file=one["file"])
            for one in whole["changes"]
        ]
        yield Phrase(
            "{file} runs all programs one after the other and changes the tools itself: {changes}. Before each change "
            "the spindle stops and the head goes to its top. Put all of these tools into the changer first, and their "
            "lengths into the control's table.",
            file=whole["file"],
            changes=join(", ", changes),
        )


def describe_restarts(spec: Mapping[str, Any], report: Mapping[str, Any]) -> list[tuple[str, list[tuple[Any, ...]]]]:
    """Return (file in words, rows: line, its text, what begins there, X Y, Z, words in force, time) of programs with
    places at which they may be entered again, in the unit of the programs.

    spec : with the whole figures of the mill under `machine`
    """
    is_inch = table(spec.get("machine")).get("units") == "inch"
    unit_mm = MM_PER_INCH if is_inch else 1.0
    whole_file = table(report.get("one_program"))
    before = {one["file"]: one["lines_before"] for one in whole_file.get("changes") or ()}
    found = []
    for file, restarts in table(report.get("restarts")).items():
        rows = []
        for row in restarts:
            x, y, z = (number(value / unit_mm, 3 + is_inch) for value in row["at_mm"])
            feed, rpm = number(row["feed_mm_per_min"] / unit_mm, 1 + is_inch), number(row["spindle_rpm"])
            words = f"G{0 if row['is_rapid'] else 1} F{feed} S{rpm}"
            begins, at_s = _RESTARTS[row["kind"]], duration(row["time_s"])
            rows.append((whole(row["line"]), row["text"], begins, f"X {x} Y {y}", z, words, at_s))
        if rows and file in before:
            whole_name, count = str(whole_file.get("file")), whole(before[file])
            file = Phrase("{file} ({whole}: {count} lines later)", file=file, whole=whole_name, count=count)
        if rows:
            found.append((file, rows))
    return found


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


def check_rows(passes: Sequence[Row]) -> list[Cells]:
    """Return (question, allowed value, one cell per pass); rows without an answer from any pass are left out."""
    asked: tuple[tuple[Phrase, str, Callable[[Row], str | None]], ...] = (
        (Phrase("Program read back and cut in simulation"), Phrase("every move"), _moves),
        (
            Phrase("Cut below the lens"),
            Phrase("1 µm, or 1.5 steps of the heights written"),
            lambda p: _number(p, "gouge_um", 2, "µm"),
        ),
        (Phrase("Deepest bite"), Phrase("the step-down and the cusps before"), _bite),
        (Phrase("Rapid moves in stock, or across below the safe height"), Phrase("none"), _none),
        (Phrase("Straight down into stock; spindle off in stock"), Phrase("none"), _none),
        (Phrase("Widest gap between tracks"), Phrase("1.5 row distances, 1.02 for contour"), _gap),
        (
            Phrase("Stock left above the planned amount, where the ball reaches"),
            Phrase("cusps, 5 µm and a quarter of the cusps"),
            lambda p: _number(p, "excess_um", 1, "µm"),
        ),
        (Phrase("Shank and end of flutes against standing stock"), Phrase("no contact"), _shank),
        (Phrase("Extent within the mill's travel"), Phrase("travel of each axis"), _extent),
        (Phrase("Entries, on ramps of {ramp_deg:g}° or in air", ramp_deg=RAMP_DEG), "", _entries),
        (Phrase("Cut climbing, by volume"), "", lambda p: _percent(p, "climb_share")),
        (Phrase("Cutting time with chips in the material's band"), Phrase("97 %, or a warning"), _chips),
        (Phrase("Cut at the ball's full width"), Phrase("deep ones at half the feed"), _slots),
        (
            Phrase("Along the contour lines (within 15°)"),
            "",
            lambda p: _percent(_part(p, "contour"), "aligned_share"),
        ),
        (Phrase("Places that a rest pass mills"), "", _rest),
        (
            Phrase("Left above Z0 by the facing, or in the slot of the cut-out"),
            Phrase("cusps"),
            lambda p: _number(p, "left_um", 1, "µm"),
        ),
        (
            Phrase("Between the cutter and the lens, cutting it out"),
            "0",
            lambda p: _number(p, "clear_um", 1, "µm"),
        ),
        (Phrase("Tabs that hold the lens"), Phrase("as asked"), _tabs),
    )
    rows = []
    for what, allowed, answer in asked:
        cells = [answer(row) if row.get("checked") else None for row in passes]
        if any(cell is not None for cell in cells):
            rows.append((what, allowed, [MISSING if cell is None else cell for cell in cells]))
    return rows


def chip_mm_of(row: Row) -> float | None:
    """Return the feed per tooth at the pass's feed; None if flutes or speed are not known."""
    flutes, rpm, feed = row.get("flutes"), row.get("spindle_rpm"), row.get("feed_mm_per_min")
    return feed / (rpm * flutes) if flutes and rpm and feed else None


def describe_bands(material: str, rows: Sequence[Row]) -> list[Phrase]:
    """Return a sentence for each diameter of cutter: our band of feed per tooth, and those that makers publish for the
    nearest diameter.
    """
    known = MATERIALS.get(material)
    found = []
    for radius_mm in sorted({row["radius_mm"] for row in rows if row.get("radius_mm")}) if known else ():
        assert known is not None
        least_mm, most_mm = known.start_values(radius_mm).chip_mm
        ours = Phrase(
            "Ø {diameter_mm:g} mm: {least_mm:g} to {most_mm:g} mm per tooth",
            diameter_mm=2 * radius_mm,
            least_mm=least_mm,
            most_mm=most_mm,
        )
        nearest_mm = min((abs(log(one[1] / 2 / radius_mm)) for one in known.makers), default=0.0)
        theirs = [
            Phrase(
                "{maker} {least_mm:g} to {most_mm:g} at Ø {diameter_mm:g}",
                maker=maker, diameter_mm=diameter_mm, least_mm=least, most_mm=most,
            )
            for maker, diameter_mm, least, most in known.makers
            if abs(abs(log(diameter_mm / 2 / radius_mm)) - nearest_mm) < 1e-9
        ]  # fmt: skip
        found.append(Phrase("{ours} ({theirs})", ours=ours, theirs=join("; ", theirs)) if theirs else ours)
    return found


def flutes_in_words(row: Row) -> str:
    """Return how long the flutes must be and, if stated, how long they are."""
    need_mm, have_mm = row.get("flute_need_mm"), row.get("flute_length_mm")
    if need_mm is None:
        return MISSING
    at_least_mm = ceil(10 * need_mm) / 10
    if have_mm is None:
        return f"{at_least_mm:g} mm"
    return Phrase("{at_least_mm:g} mm (has {length_mm:g})", at_least_mm=at_least_mm, length_mm=have_mm)


def order_in_words(row: Row) -> str:
    """Return how the tool goes over the lens in a pass."""
    if row.get("is_around"):
        if row.get("name") == WITNESS:
            return Phrase("rows beside the lens, each at its own height")
        whole_top = "above_mm" in row
        return Phrase("rows along X over the whole top") if whole_top else Phrase("around the lens, layer by layer")
    if row.get("strategy") == "contour":
        return Phrase("one path along the contour lines")
    if row.get("pitch_mm") is None:
        return ""
    parts = [Phrase("rows along {axis}", axis=str(row.get("direction", "x")).upper())]
    parts.append(Phrase("one way") if row.get("link") == "retract" else Phrase("there and back"))
    if row.get("where") == "rest":
        parts.append(Phrase("only where the ball before left stock"))
    return join(", ", parts)


def _part(row: Row, key: str) -> Row:
    value = row.get(key)
    return value if isinstance(value, Mapping) else {}


def _number(row: Row, key: str, digits: int, unit: str) -> str | None:
    return None if row.get(key) is None else number(row[key], digits, unit)


def _moves(row: Row) -> str | None:
    return None if row.get("moves") is None else Phrase("{count} moves", count=whole(row["moves"]))


def _entries(row: Row) -> str | None:
    return None if row.get("entries") is None else whole(row["entries"])


def _percent(row: Row, key: str) -> str | None:
    return None if row.get(key) is None else f"{100 * row[key]:.0f} %"


def _none(row: Row) -> str | None:
    return Phrase("none") if row.get("checked") == "passed" else None


def _bite(row: Row) -> str | None:
    if row.get("max_engagement_mm") is None:
        return None
    bite = number(row["max_engagement_mm"], 3)
    if not row.get("step_down_mm"):
        return f"{bite} mm"
    return Phrase("{bite_mm} of {step_down_mm} mm", bite_mm=bite, step_down_mm=number(row["step_down_mm"], 3))


def _gap(row: Row) -> str | None:
    if row.get("max_gap_mm") is None:
        return None
    gap = number(row["max_gap_mm"], 4)
    if not row.get("pitch_mm"):
        return f"{gap} mm"
    return Phrase("{gap_mm} at {pitch_mm} mm", gap_mm=gap, pitch_mm=number(row["pitch_mm"], 4))


def _shank(row: Row) -> str | None:
    if row.get("checked") != "passed":
        return None
    return Phrase("none") if row.get("flute_length_mm") else Phrase("not stated")


def _extent(row: Row) -> str | None:
    bounds = _part(row, "bounds")
    if row.get("checked") != "passed" or not all(len(bounds.get(axis) or ()) == 2 for axis in "xyz"):
        return None
    return " × ".join(number(bounds[axis][1] - bounds[axis][0], 1) for axis in "xyz") + " mm"


def _chips(row: Row) -> str | None:
    return _percent(_part(row, "chips"), "share")


def _slots(row: Row) -> str | None:
    if row.get("slot_length_mm") is None:
        return None
    if row["slot_length_mm"] < _SCRATCH_MM:
        return Phrase("nowhere")
    length_mm, depth_mm = number(row["slot_length_mm"], 0), number(row.get("slot_depth_mm"), 2)
    return Phrase("{length_mm} mm, {depth_mm} mm deep", length_mm=length_mm, depth_mm=depth_mm)


def _rest(row: Row) -> str | None:
    rest = _part(row, "rest")
    if not rest:
        return None
    count, area_mm2 = rest.get("regions", 0), number(rest.get("area_mm2"), 1)
    if count == 1:
        return Phrase("1 place, {area_mm2} mm²", area_mm2=area_mm2)
    return Phrase("{count:.0f} places, {area_mm2} mm²", count=count, area_mm2=area_mm2)


def _tabs(row: Row) -> str | None:
    tabs = row.get("tabs")
    if not isinstance(tabs, list):
        return None
    heights = [tab["height_mm"] for tab in tabs]
    return Phrase(
        "{count}, {least_mm} to {most_mm} mm high",
        count=len(heights),
        least_mm=number(min(heights), 2),
        most_mm=number(max(heights), 2),
    )
