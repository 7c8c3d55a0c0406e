"""Places the witness marks of a job, a strip in the block's margin cut after the last pass, and chooses their cutter.

The strip lies clear of all passes, the cut-out and the clamps of the spec, at one side of the lens. It is as deep as
the lens's highest point, so that it is cut even if the block's top is low.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cam.around.specs import WitnessCut
from cam.checking.envelope import Envelope
from optics.finish import Finish
from optics.witness import Mill, NoMarksError, Strip, choose_strip
from service.job.spec.envelope import envelope_of, reach_of_witness
from service.job.spec.lens_task import finish_of
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob, digits_of

Side = Literal["front", "back", "left", "right"]
_SIDES: tuple[Side, ...] = ("front", "back", "left", "right")
LEAST_ROW_MM, _MOST_ROW_MM = 4.0, 12.0
_BESIDE_SLOT_MM = 1.0
_MOVED_MM = 3.0
_DEEPER_MM = 0.05  # below the lens's highest point: the greatest height of ripples and steps


@dataclass(frozen=True, slots=True, kw_only=True)
class WitnessPlan:
    """strip: the marks; side: of the block, as it lies on the mill; cut: how it is milled."""

    strip: Strip
    side: Side
    cut: WitnessCut


def plan_witness(job: ResolvedJob) -> WitnessPlan:
    """Return the marks of a job whose passes and finish are known. Raises NoMarksError."""
    spec, finish = job.spec, finish_of(job.spec)
    assert finish is not None and finish.depth_mm is not None  # by FinishSpec.witnessed
    ball, depth_mm = spec.passes[-1], finish.depth_mm
    step_mm = digits_of(job.machine).coarsen(job.machine.step_mm).z_mm
    mill = Mill(radius_mm=ball.radius_mm, step_mm=step_mm, noise_mm=job.machine.z_noise_mm)
    envelope = envelope_of(spec, job.machine)
    for side in _SIDES:
        if room := _Room.of(job, side, finish, depth_mm):
            strip = choose_strip(finish, depth_mm, mill, room_mm=room.along_mm[1] - room.along_mm[0])
            for begin_mm in room.begins_mm(strip.length_mm):
                cut = _cut_of(job, side, strip, begin_mm, room, step_mm)
                if _is_clear(spec, envelope, cut):
                    return WitnessPlan(strip=strip, side=side, cut=cut)
    raise NoMarksError("room")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Room:
    """The range for axes of rows: along the side, and across it, from the outer end to the end near the lens."""

    along_mm: tuple[float, float]
    across_mm: tuple[float, float]

    @classmethod
    def of(cls, job: ResolvedJob, side: Side, finish: Finish, depth_mm: float) -> _Room | None:
        """Return the room at a side; None if there is too little, or the mill does not travel that far."""
        spec, optics, margin_mm = job.spec, job.spec.optics, job.spec.stock.margin_mm
        skim_mm, radius_mm = spec.stock.skim_mm, spec.passes[-1].radius_mm
        beside_mm = math.sqrt(2 * radius_mm * (skim_mm + _DEEPER_MM))
        swept_mm = max(2 * row.radius_mm for row in spec.passes)
        if spec.stock.cut_out is not None:
            swept_mm = max(swept_mm, 2 * spec.stock.cut_out.radius_mm + beside_mm + _BESIDE_SLOT_MM)
        outer_mm = min(margin_mm - beside_mm, swept_mm + _MOST_ROW_MM)
        wide_mm = outer_mm - swept_mm
        if skim_mm >= radius_mm or wide_mm < LEAST_ROW_MM:
            return None
        if (
            skim_mm / 2 > depth_mm * (finish.k0_rad_per_mm * wide_mm / math.pi) ** finish.order
        ):  # out of the pad's reach
            return None
        lengths, axis = (optics.width_mm, optics.height_mm), 0 if side in ("front", "back") else 1
        length_mm, other_mm = lengths[axis], lengths[1 - axis]
        if other_mm + 2 * outer_mm > job.machine.travel_mm[1 - axis]:
            return None
        ends_mm = min(margin_mm - 2 * beside_mm, (job.machine.travel_mm[axis] - length_mm) / 2)
        across_mm = (-outer_mm, -swept_mm) if side in ("front", "left") else (other_mm + outer_mm, other_mm + swept_mm)
        return cls(along_mm=(-ends_mm, length_mm + ends_mm), across_mm=across_mm)

    def begins_mm(self, length_mm: float) -> Iterator[float]:
        """Yield where a strip of that length may begin: in the middle first, then farther and farther from it."""
        spare_mm = self.along_mm[1] - self.along_mm[0] - length_mm
        for moved_mm in np.arange(0.0, spare_mm / 2 + 1e-9, _MOVED_MM):
            yield from sorted({self.along_mm[0] + spare_mm / 2 + sign * float(moved_mm) for sign in (-1, 1)})


def _cut_of(job: ResolvedJob, side: Side, strip: Strip, begin_mm: float, room: _Room, step_mm: float) -> WitnessCut:
    """Return the rows in the work frame: their highest ones not over the lens's highest point, on whole steps."""
    row = job.spec.passes[-1]
    places, tips = strip.rows()
    level_mm = -job.spec.stock.skim_mm - float(tips.max())
    if step_mm > 0.0:
        level_mm = math.floor(level_mm / step_mm + 1e-9) * step_mm
    assert row.step_down_mm is not None and row.feed_mm_per_min is not None  # by complete_job
    assert row.plunge_mm_per_min is not None and row.spindle_rpm is not None
    return WitnessCut(
        radius_mm=row.radius_mm,
        along="x" if side in ("front", "back") else "y",
        places_mm=tuple(float(place) for place in places + begin_mm),
        tips_mm=tuple(float(tip) for tip in tips + level_mm),
        across_mm=room.across_mm,
        step_down_mm=row.step_down_mm,
        feed_mm_per_min=row.feed_mm_per_min,
        plunge_mm_per_min=row.plunge_mm_per_min,
        spindle_rpm=row.spindle_rpm,
    )


def _is_clear(spec: JobSpec, envelope: Envelope, cut: WitnessCut) -> bool:
    """Return whether neither the cutter nor what holds it, as far as the job states it, comes too near to a clamp."""
    reach = reach_of_witness(spec, cut.box_mm, cut.lowest_mm)
    is_long = reach.stick_out_mm is None or reach.stick_out_mm >= envelope.least_stick_out_mm(reach)
    return is_long and not any(envelope.find_struck(reach))
