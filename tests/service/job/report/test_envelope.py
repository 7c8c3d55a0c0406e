"""What the report says of table and head holds for the written programs: a job with every kind of them."""

from __future__ import annotations

import numpy as np
import pytest

from cam.reading.gcode import LANGUAGES, read_parts
from service.job.report.envelope import describe_envelope
from service.job.spec.loading import resolve_spec
from service.job.spec.resolve import look_up
from tests.service.job.stages.jobs import StagedJob, staged_job

PROGRAMS = ["face", "rough", "contour", "rest", "witness", "cut-out"]


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    ball = {"name": "contour", "strategy": "contour", "radius_mm": 1.0, "pitch_mm": 0.2}
    spec = resolve_spec(
        base={
            "image": {"pixels": 24, "tone": "linear"},
            "optics": {"width_mm": 3, "height_mm": 3, "throw_mm": 20, "min_radius_mm": 0.5},
            "passes": [
                {"name": "rough", "radius_mm": 1.0, "pitch_mm": 0.4, "stock_to_leave_mm": 0.2},
                ball,
                {"name": "rest", "where": "rest", "radius_mm": 0.5, "pitch_mm": 0.1},
            ],
            "stock": {
                "thickness_mm": 4, "margin_mm": 20, "face": {"above_mm": 0.5},
                "cut_out": {"radius_mm": 0.5, "tabs": 2, "tab_width_mm": 0.6, "tab_height_mm": 0.3, "step_down_mm": 1},
            },
            "finish": {"process": "felt", "minutes": 1.2, "k0_rad_per_mm": 2.5, "depth_um": 16},
        }
    )  # fmt: skip
    made = staged_job(tmp_path_factory.mktemp("envelope"), spec=spec).run_all(until="check", without=("caustic",))
    made.run("check")
    return made


@pytest.mark.thorough
def test_no_program_takes_its_tool_beyond_what_the_rules_count_with(job: StagedJob) -> None:
    """But for the few micrometres that a cut-out keeps from the lens beside its radius."""
    _, envelope, reaches = describe_envelope(job.spec, look_up(job.spec).machine, job.report)
    assert list(reaches) == [f"pass-{number}-{name}.nc" for number, name in enumerate(PROGRAMS)]
    for file, reach in reaches.items():
        left, right, front, back = envelope.area_mm(reach)
        points = []
        for batch in read_parts([[job.bytes(file)]], LANGUAGES["grbl"]):
            points += [batch.start_mm, batch.end_mm]
        low = np.vstack(points)
        low = low[low[:, 2] < 4.9]  # the rapids across are at Z5
        assert low.size and low[:, 2].min() >= reach.lowest_mm - 1e-9
        assert left - 0.01 <= low[:, 0].min() and low[:, 0].max() <= right + 0.01
        assert front - 0.01 <= low[:, 1].min() and low[:, 1].max() <= back + 0.01
