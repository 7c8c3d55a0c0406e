"""The part of a job's report on table and head, once its programs are known: how far each tool sticks out, and how high
the block has to lie.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from cam.checking.envelope import Envelope, Reach
from machines.profile import MachineProfile
from service.job.files import CUT_OUT, FACE, WITNESS, table
from service.job.spec.envelope import envelope_of, list_reaches, reach_of_witness, require_envelope
from service.job.spec.model import JobSpec
from service.job.spec.resolve import tool_key


def reaches_of(spec: JobSpec, report: Mapping[str, Any]) -> dict[str, Reach]:
    """Return where each program took its tool, by its file, in the order in which they are run."""
    around, passes = table(report.get("around")), report.get("passes", ())
    lows = [float(table(row.get("bounds"))["z"][0]) for row in passes]
    by_key = list_reaches(spec, depth_mm=0.0, lowest_mm=lows)
    found = {around[FACE]["file"]: by_key["stock.face"]} if FACE in around else {}
    found |= {row["file"]: by_key[f"passes.{number}"] for number, row in enumerate(passes)}
    if WITNESS in around:
        row = around[WITNESS]
        left, right, front, back = map(float, report["witness"]["box_mm"])
        found[row["file"]] = reach_of_witness(spec, (left, right, front, back), float(row["bounds"]["z"][0]))
    if CUT_OUT in around:
        found[around[CUT_OUT]["file"]] = by_key["stock.cut_out"]
    return found


def _list_tools(spec: JobSpec, around: Mapping[str, Any]) -> list[tuple[object, ...]]:
    """Return the tool of each program, in the order of `reaches_of`."""
    stock, made = spec.stock, (*spec.passes, *(spec.passes[-1:] if WITNESS in around else ()))
    face, cut_out = stock.face if FACE in around else None, stock.cut_out if CUT_OUT in around else None
    return [tool_key(row) for row in (face, *made, cut_out) if row is not None]


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
    reaches, envelope = reaches_of(spec, report), envelope_of(spec, machine)
    lows = [reaches[row["file"]].lowest_mm for row in report.get("passes", ())]
    marks = table(table(report.get("around")).get(WITNESS)).get("file")
    require_envelope(spec, machine, depth_mm=0.0, lowest_mm=lows, witness=reaches.get(str(marks)))
    least_mm, most_mm = envelope.base_range_mm(reaches.values())
    tools = _list_tools(spec, table(report.get("around")))
    longest_mm = dict.fromkeys(tools, 0.0)
    for tool, reach in zip(tools, reaches.values(), strict=True):
        longest_mm[tool] = max(longest_mm[tool], envelope.least_stick_out_mm(reach))
    figures = {
        "stick_out_mm": {
            file: longest_mm[tool] if reach.stick_out_mm is None else reach.stick_out_mm
            for tool, (file, reach) in zip(tools, reaches.items(), strict=True)
        },
        "stated": [file for file, reach in reaches.items() if reach.stick_out_mm is not None],
        "base_mm": [max(least_mm, 0.0), most_mm if isfinite(most_mm) else None],
        "clamps_mm": [[one.x_mm, one.y_mm, one.width_mm, one.depth_mm] for one in envelope.clamps],
        "bed_to_collet_mm": machine.bed_to_collet_mm,
        "guesses": list(machine.guesses),
    }
    return figures, envelope, reaches
