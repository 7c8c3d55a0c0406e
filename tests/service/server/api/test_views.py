"""What the API shows of a job: its stages are those that its plan has made of it."""

from __future__ import annotations

from service.job.spec.loading import resolve_spec
from service.server.api.job_views import make_view
from service.server.database.records import Job, JobState

BALL = {"radius_mm": 3.0, "pitch_mm": 0.2}


def job(report: dict[str, object] | None) -> Job:
    spec = resolve_spec(preset="recommended").plain()
    return Job(
        id="a" * 26, name="a", state=JobState.RUNNING, priority=0, spec=spec, figures=None, image_sha256="b" * 64,
        image_bytes=1, created_by="c", created_at=0.0, queued_at=0.0, started_at=0.0, ended_at=None, stage=None,
        progress=0.0, error=None, report=report, cancel_requested=False, attempt=1, owner=None, fence=1, version=1,
    )  # fmt: skip


def passes_shown(report: dict[str, object] | None) -> list[str]:
    shown = make_view(job(report), position=None, progress=None, picture=None, runs=(), files=()).stages
    assert abs(sum(stage.share for stage in shown) - 1.0) < 1e-3
    return [stage.name for stage in shown if stage.name.startswith("pass-")]


def test_once_passes_are_planned_their_stages_are_shown() -> None:
    """Until then those of usual ones."""
    rows = [{"name": "rough", "stock_to_leave_mm": 0.2, **BALL}, {"name": "rough", "stock_to_leave_mm": 0.1, **BALL}]
    plan = {"passes": [*rows, BALL], "min_radius_mm": 3.0, "foreseen_blur_mm": [0.0, 0.3], "whole_steps": True}
    assert passes_shown(None) == ["pass-1", "pass-2"]
    assert passes_shown({"plan": plan}) == ["pass-1", "pass-2", "pass-3"]
