"""report.html: the setup sheet a person takes to the mill, from report.json, spec.json and the names of the files; its
words stand in templates/report.html.

Optional parts may be missing: after `design` there are no passes, and the page says so. The page has no scripts and
only loads the pictures beside it.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cache, reduce
from math import ceil, floor, isfinite, radians, tan
from pathlib import PurePath
from typing import Any

from jinja2 import Environment, PackageLoader, Template
from markupsafe import Markup

from cam.materials import MATERIALS
from cam.posts.dialects import POSTS
from cam.posts.post import Post
from phrases.phrase import Phrase, restore, say
from service.job.files import WITNESS, list_programs, table
from service.job.report.block import BlockSizes, plan_holding, side_view, top_view
from service.job.report.finishing import make_finishing_card
from service.job.report.milled import sentences_as_milled
from service.job.report.optics import (
    lens_rows,
    light_sentences,
    score_rows,
    screen_sentence,
    sentences_of_preparation,
    tolerance_sentences,
)
from service.job.report.other_shop import rows_for_another_shop
from service.job.report.passes import (
    around_sentences,
    check_rows,
    chip_mm_of,
    describe_bands,
    describe_restarts,
    explain_zero_before_facing,
    flutes_in_words,
    order_in_words,
)
from service.job.report.pictures import PICTURES
from service.job.spec.lens_task import source_spread_mm
from service.job.spec.light import SUN_DEG
from service.job.spec.optics import ellipse_mm
from service.page.files import FOLDER
from service.wording import cutter, duration, number, shape_of, size, whole

_SLENDER = 12.0  # free length over diameter from which a plain end mill bends too far
_PLACES_SHOWN = 6
_COARSE_PIXELS = 256  # up to this size a picture is shown with sharp pixels, not interpolated

LANGUAGES = tuple(sorted(path.stem for path in FOLDER.glob("languages/*.json")))
"""Languages in addition to English: those of the operator page."""

_AS_MILLED, _AS_FINISHED = "caustic-as-milled.png", "caustic-as-finished.png"


def render_page(setup: Mapping[str, Any], language: str = "en") -> str:
    """Return the page as HTML text, from what `describe_setup` returns."""
    return _template().render(in_language(setup, language))


def render_block(name: str, setup: Mapping[str, Any]) -> str:
    """Return the HTML of one block of the page, from what `in_language` returns."""
    template = _template()
    return "".join(template.blocks[name](template.new_context(dict(setup))))


def in_language(setup: Mapping[str, Any], language: str) -> dict[str, Any]:
    """Return the result of `describe_setup` in another language, and the function `t` that translates templates."""
    words = {} if language == "en" else _read_table(language)

    def t(template: str, **values: object) -> Markup:
        """Return HTML: the template is trusted, its values are not."""
        return Markup(words.get(template, template)).format(**values)

    return {**say(setup, words), "t": t, "language": language}


@cache
def _read_table(language: str) -> dict[str, str]:
    tables = (FOLDER / "languages" / f"{folder}{language}.json" for folder in ("", "server/"))
    return {key: words for path in tables for key, words in json.loads(path.read_text("utf-8")).items()}


def describe_setup(
    report: Mapping[str, Any],
    *,
    spec: Mapping[str, Any] | None = None,
    files: Collection[str] = (),
) -> dict[str, Any]:
    """Return the contents of the sheet, by the names in its template.

    report : what report.json holds     spec : what spec.json holds     files : names present in the job's folder
    """
    spec, report = spec or {}, restore(report, table(report.get("phrases")))
    programs = _programs(report, spec)
    passes = [row for row in programs if not row["is_around"]]
    block = _block_of(report, spec, programs)
    highest_mm = max((_z_bounds(row)[1] for row in programs if _z_bounds(row)), default=None)
    rapid_z_mm = table(spec.get("machine")).get("safe_z_mm") or highest_mm
    holding = plan_holding(block, _lows(programs, block), rapid_z_mm, faced=bool(table(spec.get("stock")).get("face")))
    under_head = table(report.get("envelope"))
    for row in programs:
        _state_stick_out(row, under_head, holding.clearance_mm)
    warnings = [*_sentences(report.get("warnings")), *_tool_warnings(passes, holding.clearance_mm)]
    return {
        "title": _job_name(report) or Phrase("lens"),
        "report": report,
        "optics": table(report.get("optics")),
        "spec": {key: table(spec.get(key)) for key in ("image", "optics", "stock", "machine")},
        "block": block,
        "top_view": top_view(block) if block else None,
        "side_view": side_view(block) if block else None,
        "passes": programs,
        "unreached": _list_unreached(passes),
        "verdict": _verdict(programs),
        "total_s": sum(row["time_s"] for row in programs) if all(row.get("time_s") for row in programs) else None,
        "warnings": warnings,
        "notes": [note for note in _notes(programs) if note not in warnings],
        "around": around_sentences(spec, report),
        "bands": describe_bands(str(table(spec.get("stock")).get("material")), programs),
        "material": _describe_block(table(spec.get("stock")).get("material")),
        "facing_zero": explain_zero_before_facing(spec),
        "coarse": 0 < (table(spec.get("image")).get("pixels") or 0) <= _COARSE_PIXELS,
        "score_rows": score_rows(report),
        "milled": sentences_as_milled(table(report.get("as_milled")), finished=bool(report.get("finishing"))),
        "prepared": sentences_of_preparation(report),
        "lens_rows": lens_rows(report, spec),
        "throw": _throw(block, spec, passes, table(table(report.get("optics")).get("tolerances"))),
        "check_rows": check_rows(programs),
        "finishing": make_finishing_card(report),
        "other_shop": rows_for_another_shop(spec, report, frozenset(files)),
        "holding": asdict(holding),
        "base": list(_describe_base(spec, under_head)),
        "rapid_z_mm": rapid_z_mm,
        "tool_changes": _tool_changes(programs, has_lengths=bool(table(spec.get("machine")).get("tool_change"))),
        "top_guess": _describe_top(table(spec.get("machine"))),
        "restarts": describe_restarts(spec, report),
        "one_program": table(report.get("one_program")),
        "lowest_z_mm": min((_z_bounds(row)[0] for row in passes if _z_bounds(row)), default=0.0),
        "main_pictures": _list_walls(files),
        "finish_pictures": [name for name in (_AS_MILLED, _AS_FINISHED) if {_AS_MILLED, _AS_FINISHED} <= set(files)],
        "tolerance_picture": next(
            (asdict(one) for one in PICTURES if one.name in files and one.shown == "finish"), None
        ),
        "pictures": [asdict(one) for one in PICTURES if one.name in files and one.shown in ("page", "sheet")],
        "files": frozenset(files),
    }


def _state_stick_out(row: dict[str, Any], under_head: Mapping[str, Any], clearance_mm: float) -> None:
    """State how far a program's tool sticks out: as the job says, or at least so far."""
    file = str(row.get("file"))
    need_mm = clearance_mm - min(_z_bounds(row)[0], 0.0) if _z_bounds(row) else None
    need_mm = table(under_head.get("stick_out_mm")).get(file, need_mm)
    row["stick_out_mm"] = need_mm
    if need_mm is not None:
        is_stated = file in (under_head.get("stated") or ())
        shown_mm = number(need_mm if is_stated else ceil(10 * need_mm - 1e-6) / 10, 1, "mm")
        row["stick_out"] = shown_mm if is_stated else f"≥ {shown_mm}"


def _describe_base(spec: Mapping[str, Any], under_head: Mapping[str, Any]) -> Iterator[Phrase]:
    """Say how high the block lies, and what of the head is a guess."""
    if not under_head:
        return
    (least_mm, most_mm), stated_mm = under_head["base_mm"], table(spec.get("stock")).get("base_mm")
    collet_mm = under_head["bed_to_collet_mm"]
    if stated_mm is not None:
        yield Phrase("The block lies {base_mm:g} mm over the table, as the job says.", base_mm=stated_mm)
    elif most_mm is not None and least_mm > 0:
        yield Phrase(
            "Lay the block {least_mm} to {most_mm} mm over the table (spoil board, sub plate, vice): lower, tools do "
            "not come down to their cut, or cut into the table; higher, the head has no room above it.",
            least_mm=number(ceil(10 * least_mm) / 10),
            most_mm=number(floor(10 * most_mm) / 10),
        )
    elif most_mm is not None:
        yield Phrase(
            "The block lies on the table, or up to {most_mm} mm over it (spoil board, sub plate, vice).",
            most_mm=number(floor(10 * most_mm) / 10),
        )
    if collet_mm is None:
        yield Phrase(
            "How high the collet goes over the table is not known for this mill (machine.bed_to_collet_mm): check that "
            "block and tools fit under it."
        )
    elif "bed_to_collet_mm" in under_head["guesses"]:
        yield Phrase(
            "That counts on {collet_mm:g} mm from the table to the collet with the head at its top, which is a guess: "
            "measure it, and give it as machine.bed_to_collet_mm.",
            collet_mm=collet_mm,
        )


def _list_walls(files: Collection[str]) -> list[dict[str, Any]]:
    """Return the existing pictures of the wall: the target, then what will be seen, the ideal last."""
    found = [asdict(one) for one in PICTURES if one.name in files and one.shown == "wall"]
    return [*found[:1], *reversed(found[1:])]


def _describe_block(material: Any) -> str:
    """Describe the block's material as it is sold; if the material is no longer known, return its name."""
    name = str(material or "")
    return MATERIALS[name].block if name in MATERIALS else name


def _job_name(report: Mapping[str, Any]) -> str:
    """Return the name as on the operator page: without the file extension."""
    return PurePath(str(table(report.get("source")).get("file") or "")).stem


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("service.job.report", "templates"), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(number=number, whole=whole, duration=duration, size=size)
    return environment.get_template("report.html")


def _sentences(value: Any) -> list[str]:
    return [value] if isinstance(value, str) else [str(sentence) for sentence in value or ()]


def _lows(programs: Sequence[Mapping[str, Any]], block: BlockSizes | None) -> list[tuple[float, float]]:
    """Return (ring that it leaves around the block, lowest Z) of each program [mm]."""
    swept = [(one, _z_bounds(row)[0]) for row in programs if (one := _swept([row])) and _z_bounds(row)]
    return [] if block is None else [(block.ring_beside_mm(one), low_mm) for one, low_mm in swept]


def _block_of(
    report: Mapping[str, Any], spec: Mapping[str, Any], passes: Sequence[Mapping[str, Any]]
) -> BlockSizes | None:
    """Return the sizes to draw; None if the spec does not give them."""
    optics, stock = table(spec.get("optics")), table(spec.get("stock"))
    relief_mm = table(report.get("optics")).get("relief_mm")
    try:
        return BlockSizes(
            width_mm=float(optics["width_mm"]),
            height_mm=float(optics["height_mm"]),
            throw_mm=float(optics["throw_mm"]),
            thickness_mm=float(stock["thickness_mm"]),
            margin_mm=float(stock.get("margin_mm", 0.0)),
            is_mirror=optics.get("surface") == "mirror",
            lamp_mm=table(optics.get("light")).get("distance_mm"),
            outline_mm=_outline(optics),
            swept_mm=_swept(passes),
            witness_mm=_box(table(report.get("witness")).get("box_mm")),
            clamps_mm=table(report.get("envelope")).get("clamps_mm")
            or [_clamp(one) for one in stock.get("clamps") or ()],
            deepest_mm=None if relief_mm is None else float(relief_mm) + float(stock.get("skim_mm", 0.0)),
        )
    except (KeyError, TypeError, ValueError):
        return None


def _outline(optics: Mapping[str, Any]) -> Sequence[Sequence[float]]:
    """Return the corners of a lens that is not a rectangle."""
    outline = optics.get("outline", "rectangle")
    if outline == "ellipse":
        return ellipse_mm(float(optics["width_mm"]), float(optics["height_mm"]))
    return () if isinstance(outline, str) else [(float(x), float(y)) for x, y in outline]


def _clamp(box: Mapping[str, Any]) -> tuple[float, float, float, float]:
    """Return left, front, width and depth of a clamp."""
    return float(box["x_mm"]), float(box["y_mm"]), float(box["width_mm"]), float(box["depth_mm"])


def _box(sides: Any) -> tuple[float, float, float, float] | None:
    if not sides:
        return None
    left, right, front, back = map(float, sides)
    return left, right, front, back


def _swept(passes: Sequence[Mapping[str, Any]]) -> tuple[float, float, float, float] | None:
    """Return left, right, front and back of the area that the balls of all programs cover, including their radius, but
    without the strip of witness marks.
    """
    sides = []
    for row in passes:
        if row.get("name") == WITNESS:
            continue
        bounds, radius_mm = table(row.get("cut_bounds")) or table(row.get("bounds")), row.get("radius_mm")
        if radius_mm is None or not all(len(bounds.get(axis) or ()) == 2 for axis in "xy"):
            return None
        (left, right), (front, back) = bounds["x"], bounds["y"]
        sides.append((left - radius_mm, right + radius_mm, front - radius_mm, back + radius_mm))
    if not sides:
        return None
    lefts, rights, fronts, backs = zip(*sides, strict=True)
    return min(lefts), max(rights), min(fronts), max(backs)


def _programs(report: Mapping[str, Any], spec: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of the existing programs, with the consequences for the tool."""
    rows = [row for row in list_programs(spec, report) if row["is_made"]]
    for row in rows:
        row["faults"], row["notes"] = _sentences(row.get("faults")), _sentences(row.get("notes"))
        row["checked"] = "FAILED" if row["faults"] or row.get("ok") is False else "passed" if row.get("ok") else None
        row["shape"] = shape_of(row)
        row["cuts_high"], row["order"] = flutes_in_words(row), order_in_words(row)
        row["chip_mm"] = chip_mm_of(row)
    return rows


def _tool_changes(passes: Sequence[Mapping[str, Any]], *, has_lengths: bool) -> str:
    """Say when Z0 has to be set again: only after a tool change, and never where the control has the tools' lengths."""
    if has_lengths:
        return Phrase(
            "It is set once: the length of each tool is in the control's table, under the number of the tool."
        )
    radii = [row.get("radius_mm") and cutter(row) for row in passes]
    changed = [k for k in range(1, len(radii)) if radii[k] is None or radii[k] != radii[k - 1]]
    if len(radii) < 2:
        return ""
    if not changed:
        return Phrase("All passes use the same tool: it stays in, and Z0 is set once.")
    named = [Phrase("pass {number}", number=passes[k]["number"]) for k in changed]
    before = reduce(lambda names, name: Phrase("{first} and {second}", first=names, second=name), named)
    if len(changed) == len(radii) - 1:
        return Phrase("Set it again after each tool change, that is before {passes}.", passes=before)
    return Phrase(
        "Set it again after each tool change, that is before {passes}; between the others the tool stays in and Z0 as "
        "it is.",
        passes=before,
    )


def _describe_top(machine: Mapping[str, Any]) -> Phrase | str:
    """Say what nobody has tried of the way to the head's top, and how the owner finds out."""
    post = POSTS.get(str(machine.get("dialect")))
    if not isinstance(post, Post) or not post.guesses_top or machine.get("top_z_mm") is None:
        return ""
    return Phrase(
        "We only guess that G16 H0 goes to machine Z{top_z_mm:g} while a tool length (G56) is in force: before the "
        "first cut run a program without a block on the table, block by block, and see that the head goes up in each "
        "G16 line.",
        top_z_mm=machine["top_z_mm"],
    )


def _notes(passes: Sequence[Mapping[str, Any]]) -> list[Phrase]:
    return [Phrase("{file}: {note}", file=_file_of(row), note=note) for row in passes for note in row["notes"]]


def _file_of(row: Mapping[str, Any]) -> str:
    return str(row.get("file", Phrase("a pass")))


def _list_unreached(passes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the worst few places where the last ball cannot touch the lens. Stock of earlier balls is removed by later
    ones.
    """
    places = (passes[-1].get("unreached") or ()) if passes else ()
    return [place if isinstance(place, str) else _place_in_words(table(place)) for place in places[:_PLACES_SHOWN]]


def _place_in_words(place: Mapping[str, Any]) -> Phrase:
    return Phrase(
        "X {x_mm} Y {y_mm}: {excess_um} µm remain, over {area_mm2} mm²",
        x_mm=number(place.get("x_mm"), 2),
        y_mm=number(place.get("y_mm"), 2),
        excess_um=number(place.get("excess_um"), 1),
        area_mm2=number(place.get("area_mm2"), 3),
    )


def _z_bounds(row: Mapping[str, Any]) -> tuple[float, ...]:
    """Return (lowest, highest) Z of a program; empty if the report has none."""
    bounds = table(row.get("bounds")).get("z") or ()
    return tuple(float(z) for z in bounds if z is not None and isfinite(z)) if len(bounds) == 2 else ()


def _verdict(passes: Sequence[Mapping[str, Any]]) -> tuple[str, Phrase]:
    """Return (kind, sentence) of the box at the top."""
    if not passes:
        return "none", Phrase("No programs yet: this folder holds the lens only.")
    failed = [str(row.get("file", "?")) for row in passes if row["checked"] == "FAILED"]
    if failed:
        return "bad", Phrase("Do not mill. The check found faults in {files}.", files=", ".join(failed))
    if not all(row["checked"] for row in passes):
        return "none", Phrase("No check is recorded for some of these programs: check them before you mill.")
    if len(passes) == 1:
        return "good", Phrase("The program passed the check: read back from the written file and cut in simulation.")
    return "good", Phrase(
        "All {count} programs passed the check: read back from the written file and cut in simulation.",
        count=len(passes),
    )


def _tool_warnings(passes: Sequence[Mapping[str, Any]], clearance_mm: float) -> list[Phrase]:
    """Return warnings on cutters that have to reach deeper than a plain end mill of their diameter can."""
    sentences = []
    for row in passes:
        radius_mm, stick_out_mm = row.get("radius_mm"), row.get("stick_out_mm")
        if radius_mm and stick_out_mm and stick_out_mm > _SLENDER * 2 * radius_mm:
            sentences.append(
                Phrase(
                    "{file}: a ball of {diameter_mm:g} mm diameter has to reach {depth_mm:.1f} mm deep, {times:.0f} "
                    "times its diameter with clearance. Use a tapered ball cutter or one with a long relieved neck, "
                    "and check that it clears the walls of the lens. A wall farther away makes the lens flatter, about "
                    "half as deep at twice the distance.",
                    file=_file_of(row),
                    diameter_mm=2 * radius_mm,
                    depth_mm=stick_out_mm - clearance_mm,
                    times=stick_out_mm / (2 * radius_mm),
                )
            )
    return sentences


def _throw(
    block: BlockSizes | None,
    spec: Mapping[str, Any],
    passes: Sequence[Mapping[str, Any]],
    tolerances: Mapping[str, Any],
) -> dict[str, Any] | None:
    """Return figures for the paragraph on the distance to the wall and the lamp."""
    if block is None:
        return None
    optics, image, stock = table(spec.get("optics")), table(spec.get("image")), table(spec.get("stock"))
    radii = [row.get("radius_mm") or 0.0 for row in passes]
    own_mm = tolerances.get("blur_mm") or source_spread_mm(spec, block.throw_mm)
    spread_mm = block.throw_mm * 2 * tan(radians(SUN_DEG) / 2) if own_mm is None else own_mm
    screen_mm = float(optics.get("screen_width_mm") or block.width_mm)
    pixel_mm = screen_mm / float(image["pixels"]) if image.get("pixels") else None
    return {
        "one_percent_mm": 0.01 * block.throw_mm,
        "tolerances": tolerance_sentences(tolerances, throw_mm=block.throw_mm),
        "from_back_mm": block.throw_mm + block.thickness_mm,
        "ring_stays": block.ring_mm > 0 and block.margin_mm > 2 * max(radii, default=0.0) and not stock.get("cut_out"),
        "spread_mm": spread_mm,
        "spread_pixels": spread_mm / pixel_mm if pixel_mm else None,
        "is_sun": own_mm is None,
        "light": light_sentences(spec),
        "screen": screen_sentence(spec),
        "viewed_from": optics.get("viewed_from"),
    }
