"""Estimates the size of programs from the spec alone, before anything is computed."""

from __future__ import annotations

from service.job.spec.model import USUAL_ROWS, JobSpec

FINISH_BYTES_PER_MM, ROUGH_BYTES_PER_MM = 160.0, 20.0  # of path, on a photograph; right within a factor of three
SURE = 4.0  # a disk with less than the estimate over this number certainly cannot hold them


def pass_bytes(size_mm: tuple[float, float], *, radius_mm: float, pitch_mm: float, finishes: bool) -> float:
    """Return the bytes of one pass over a lens of this width and height."""
    width_mm, height_mm = (side_mm + 2 * radius_mm for side_mm in size_mm)
    return width_mm * height_mm / pitch_mm * (FINISH_BYTES_PER_MM if finishes else ROUGH_BYTES_PER_MM)


def job_bytes(spec: JobSpec) -> float:
    """Return the bytes of all programs of a job."""
    size_mm = (spec.optics.width_mm, spec.optics.height_mm)
    return sum(
        pass_bytes(size_mm, radius_mm=row.radius_mm, pitch_mm=row.pitch_mm, finishes=row.stock_to_leave_mm == 0)
        for row in spec.passes or USUAL_ROWS
    )
