"""One job to begin with: for `make`, `plan` and the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from service.cli import plan
from service.job.spec.loading import DEFAULT_JOB, default_layer, resolve_spec
from service.job.spec.resolve import ResolvedJob
from service.server.api.routes.page import MADE

PICTURE = Path(__file__).parents[3] / "examples" / "logo.png"


class _PlannedError(Exception):
    pass


def test_make_plan_and_page_begin_with_one_job(monkeypatch: pytest.MonkeyPatch) -> None:
    """`plan` left the finish out, and the page the margin, so that each promised another lens."""
    jobs: list[ResolvedJob] = []

    def note(job: ResolvedJob, target: Any) -> None:
        jobs.append(job)
        raise _PlannedError

    monkeypatch.setattr(plan, "plan_for_picture", note)
    request = plan.PlanRequest(
        source=PICTURE, machine=None, goal={}, tools=None, output=None, spec=None, overrides=("image.pixels=32",)
    )
    with pytest.raises(_PlannedError):
        list(plan.run_plan(request, as_json=True))
    made = resolve_spec(base=default_layer(file=None, preset=None, overrides=()), overrides=["image.pixels=32"])
    schema: Any = MADE["new/spec_schema.js"][1]()
    assert schema["default"] == DEFAULT_JOB
    assert jobs[0].spec == made == resolve_spec(base=schema["default"], overrides=["image.pixels=32"])
    assert (made.finish.process, made.stock.margin_mm) == ("best", 20.0)
