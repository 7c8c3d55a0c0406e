"""The part of a job's report on table and head, once its programs are known: how far each tool sticks out, and how high
the block has to lie.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any

from cam.checking.envelope import Envelope, Reach
from machines.profile import MachineProfile
from service.job.files import CUT_OUT, FACE, WITNESS, table
from service.job.spec.envelope import envelope_of, list_reaches, reach_of_witness, require_envelope
from service.job.spec.model import JobSpec
from service.job.spec.resolve import Cutter, tool_key


def _list_programs(spec: JobSpec, report: Mapping[str, Any]) -> Iterator[tuple[str, Cutter, Reach]]:
    """Yield each program in the order in which they are run: its file, its tool, and where it takes it."""
    around, passes, stock = table(report.get("around")), report.get("passes", ()), spec.stock
    lows = [float(table(row.get("bounds"))["z"][0]) for row in passes]
    by_key = list_reaches(spec, depth_mm=0.0, lowest_mm=lows)
    if stock.face is not None and FACE in around:
        yield around[FACE]["file"], stock.face, by_key["stock.face"]
    for number, row in enumerate(passes):
        yield row["file"], spec.passes[number], by_key[f"passes.{number}"]
    if WITNESS in around:
        row = around[WITNESS]
        left, right, front, back = map(float, report["witness"]["box_mm"])
        reach = reach_of_witness(spec, (left, right, front, back), float(row["bounds"]["z"][0]))
        yield row["file"], spec.passes[-1], reach
    if stock.cut_out is not None and CUT_OUT in around:
        yield around[CUT_OUT]["file"], stock.cut_out, by_key["stock.cut_out"]


def describe_envelope(
    spec: JobSpec, machine: MachineProfile, report: Mapping[str, Any]
) -> tuple[dict[str, Any], Envelope, dict[str, Reach]]:
    """Return figures for the report, and the envelope from which they were taken. SpecError if a program does not fit
    after all.

    stick_out_mm : by file; stated: the files whose tool is clamped as the job says, the others are at least so long,
                   those of one tool as long as the program that needs most
    clamps_mm    : left, front, width and depth of each
    base_mm      : least and greatest height of the base under the block; None: no bound is known
    """
    programs, envelope = list(_list_programs(spec, report)), envelope_of(spec, machine)
    reaches = {file: reach for file, _, reach in programs}
    lows = [reaches[row["file"]].lowest_mm for row in report.get("passes", ())]
    marks = table(table(report.get("around")).get(WITNESS)).get("file")
    require_envelope(spec, machine, depth_mm=0.0, lowest_mm=lows, witness=reaches.get(str(marks)))
    least_mm, most_mm = envelope.base_range_mm(reaches.values())
    longest_mm: dict[tuple[object, ...], float] = {}
    for _, tool, reach in programs:
        key = tool_key(tool)
        longest_mm[key] = max(longest_mm.get(key, 0.0), envelope.least_stick_out_mm(reach))
    figures = {
        "stick_out_mm": {
            file: longest_mm[tool_key(tool)] if reach.stick_out_mm is None else reach.stick_out_mm
            for file, tool, reach in programs
        },
        "stated": [file for file, reach in reaches.items() if reach.stick_out_mm is not None],
        "base_mm": [max(least_mm, 0.0), most_mm if isfinite(most_mm) else None],
        "clamps_mm": [[one.x_mm, one.y_mm, one.width_mm, one.depth_mm] for one in envelope.clamps],
        "bed_to_collet_mm": machine.bed_to_collet_mm,
        "guesses": list(machine.guesses),
    }
    return figures, envelope, reaches
