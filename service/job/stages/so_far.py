"""How far a job has come: what stage is next, and what those before it have made. The same for a folder of the command
line and for a job of the server.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from service.job.spec.resolve import ResolvedJob, with_plan
from service.job.stages.order import merge_notes, merge_reports
from service.job.stages.table import plan


@dataclass
class JobSoFar:
    """job: with its passes, once they are planned; report, notes: of the stages that are done, merged."""

    job: ResolvedJob
    report: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    def stages(self) -> Iterator[str]:
        """Yield every stage in order, each once the one before has been added. Planning changes those to come only."""
        done = 0
        while done < len(stages := plan(self.job.spec)):
            yield stages[done]
            done += 1

    def add(self, report: Mapping[str, Any], notes: Mapping[str, list[str]]) -> None:
        """Add what a stage has made."""
        self.report = merge_reports((self.report, report))
        self.notes = merge_notes((self.notes, notes))
        self.job = self.job.with_spec(with_plan(self.job.spec, self.report))
