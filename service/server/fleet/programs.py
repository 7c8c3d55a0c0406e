"""The programs of a job, and what a person has to set up before each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from phrases.phrase import Phrase
from service.job.files import is_program, list_programs, program_order
from service.server.database.records import Artifact, Job
from service.wording import ball, shape_of

Json = dict[str, Any]

_SHAPES = {
    "ball": Phrase("ball end mill"),
    "flat": Phrase("flat end mill"),
    "bull-nose": Phrase("bull-nose end mill"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """One program of a job, or one part of a pass: number from 1 in the order of running, file name, hash, size.

    pass_number : of the pass, from 1; part: of it, from 1
    """

    number: int
    pass_number: int
    part: int
    name: str
    sha256: str
    bytes: int


def programs_of(files: Sequence[Artifact]) -> list[Program]:
    """Return the programs among a job's files, in the order in which they are run."""
    found = sorted((file for file in files if is_program(file.name)), key=lambda file: program_order(file.name))
    passes = [program_order(file.name)[0] for file in found]
    return [
        Program(
            number=number,
            pass_number=passes[number - 1],
            part=number - passes.index(passes[number - 1]),
            name=file.name,
            sha256=file.sha256,
            bytes=file.bytes,
        )
        for number, file in enumerate(found, 1)
    ]


def set_up(job: Job, number: int, part: int = 1) -> Json:
    """Return tool, block, zero and what changes since the program before, from the job's own spec and report.

    number : of the pass, as in the program's name; part: of it, from 1
    """
    rows = list_programs(job.spec, job.report or {})
    row: Json = next((row for row in rows if row["number"] == number), {})
    before: Json = next((row for row in reversed(rows) if row["number"] < number), {})
    tool = {"shape": _shape(row), "radius_mm": row.get("radius_mm"), "spindle_rpm": row.get("spindle_rpm")}
    optics, stock = _table(job.spec, "optics"), _table(job.spec, "stock")
    margin_mm = float(stock.get("margin_mm", 0.0))
    width_mm, height_mm, thickness_mm = optics.get("width_mm"), optics.get("height_mm"), stock.get("thickness_mm")
    block = {
        "width_mm": None if width_mm is None else width_mm + 2 * margin_mm,
        "height_mm": None if height_mm is None else height_mm + 2 * margin_mm,
        "thickness_mm": thickness_mm,
        "margin_mm": margin_mm,
        "material": stock.get("material"),
    }
    top = Phrase("the block's top")
    if not number:
        top = Phrase("{above_mm:g} mm below the raw top", above_mm=row.get("above_mm") or 0)
    zero = Phrase(
        "X0 Y0: front left corner of the lens, {margin_mm:g} mm from the block's left and front edges; Z0: {top}",
        margin_mm=margin_mm,
        top=top,
    )
    change = _same_pass(row) if part > 1 else _change(row, before) if before or number > 1 else None
    return {"tool": tool, "stock": block, "zero": zero, "change": change}


def _same_pass(row: Mapping[str, Any]) -> Json:
    """Return no change between two parts of one pass: a mark would show where one goes on from the other."""
    radius = row.get("radius_mm")
    words = Phrase(
        "the same tool as before, {tool}, and all zeros as they are: the pass goes on where it ended", tool=_tool(row)
    )
    return {"from_radius_mm": radius, "to_radius_mm": radius, "words": words}


def _change(row: Mapping[str, Any], before: Mapping[str, Any]) -> Json:
    """Return what to do between two passes. The work zero in X and Y stays; a tool's length is its own."""
    old, new = before.get("radius_mm"), row.get("radius_mm")
    if old is not None and old == new and _shape(row) == _shape(before):
        words = Phrase("the same tool as before, {tool}: it stays in, and all zeros as they are", tool=_tool(row))
    else:
        words = Phrase(
            "change the tool from {old} to {new}, set Z zero again; X and Y zero stay",
            old=_tool(before),
            new=_tool(row),
        )
    return {"from_radius_mm": old, "to_radius_mm": new, "words": words}


def _shape(row: Mapping[str, Any]) -> str:
    shape = shape_of(row)
    return _SHAPES.get(shape, f"{shape} end mill")


def _tool(row: Mapping[str, Any]) -> str:
    """Return size and, where it is no ball, shape."""
    shape, size = shape_of(row), "R ?" if row.get("radius_mm") is None else ball(row["radius_mm"])
    if shape == "bull-nose":
        return Phrase("bull-nose {size}, corner R {corner_mm:g} mm", size=size, corner_mm=row["corner_radius_mm"])
    return size if shape == "ball" else Phrase("flat {size}", size=size) if shape == "flat" else f"{shape} {size}"


def _table(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = values.get(name)
    return found if isinstance(found, dict) else {}
