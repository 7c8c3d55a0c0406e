"""What a job's report says of table and head, once its programs are known: how far each tool sticks out, and how high
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


def describe_envelope(
    spec: JobSpec, machine: MachineProfile, report: Mapping[str, Any]
) -> tuple[dict[str, Any], Envelope, dict[str, Reach]]:
    """Return figures for the report, and what they were taken from. SpecError if a program does not fit after all.

    stick_out_mm : by file; stated: the files whose tool is clamped as the job says, the others are at least so long
    clamps_mm    : left, front, width and depth of each
    base_mm      : least and greatest height of what the block lies on; None: no bound is known
    """
    reaches, envelope = reaches_of(spec, report), envelope_of(spec, machine)
    lows = [reaches[row["file"]].lowest_mm for row in report.get("passes", ())]
    require_envelope(spec, machine, depth_mm=0.0, lowest_mm=lows)
    least_mm, most_mm = envelope.base_range_mm(reaches.values())
    figures = {
        "stick_out_mm": {file: envelope.stick_out_mm(reach) for file, reach in reaches.items()},
        "stated": [file for file, reach in reaches.items() if reach.stick_out_mm is not None],
        "base_mm": [max(least_mm, 0.0), most_mm if isfinite(most_mm) else None],
        "clamps_mm": [[one.x_mm, one.y_mm, one.width_mm, one.depth_mm] for one in envelope.clamps],
        "bed_to_collet_mm": machine.bed_to_collet_mm,
        "guesses": list(machine.guesses),
    }
    return figures, envelope, reaches
