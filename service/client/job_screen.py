"""How a job looks from the client: a bar per stage on a terminal, plain lines otherwise, nothing when quiet."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from service.client.server import shown
from service.errors import printable
from service.progress import PlainReporter, QuietReporter, Reporter, TerminalReporter


@dataclass(slots=True)
class JobScreen:
    """Takes a job's events in the order of the server and shows each stage's life once."""

    reporter: Reporter
    quiet: bool
    _begun: set[str] = field(default_factory=set)

    def say(self, line: str) -> None:
        if not self.quiet:
            print(printable(line), flush=True)  # rich moves its bars out of the way

    def take(self, kind: str, data: dict[str, Any]) -> None:
        stage = shown(data.get("stage", ""))
        match kind:
            case "stage.started":
                self._begin(stage)
            case "progress" if stage in self._begun:
                self.reporter.reached(stage, _number(data.get("share")))
            case "stage.committed":
                self._begin(stage)
                self._begun.discard(stage)
                self.reporter.ended(stage, _number(data.get("seconds")))
            case "stage.reused":
                self.say(f"{stage}: done before, taken over")
            case "stage.interrupted":
                self._begun.discard(stage)
                self.say(f"{stage}: interrupted, it will be done again")
            case "cancel.requested":
                self.say("cancelling ...")

    def _begin(self, stage: str) -> None:
        if stage not in self._begun:
            self._begun.add(stage)
            self.reporter.started(stage)


@contextlib.contextmanager
def job_screen(*, quiet: bool) -> Iterator[JobScreen]:
    if quiet:
        yield JobScreen(QuietReporter(), quiet=True)
    elif sys.stdout.isatty():
        from rich.console import Console

        with TerminalReporter(Console()) as bars:
            yield JobScreen(bars, quiet=False)
    else:
        yield JobScreen(PlainReporter(sys.stdout), quiet=False)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else 0.0
