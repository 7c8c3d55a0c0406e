"""Progress of a command: a bar per stage on a terminal, plain lines otherwise, nothing when quiet."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Protocol, Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

Fraction = Callable[[float], None]


class Reporter(Protocol):
    """Receives the start of each stage, its progress (0 to 1), and its end. Stages may overlap."""

    def start_stage(self, stage: str) -> None: ...
    def report_share(self, stage: str, share: float) -> None: ...
    def end_stage(self, stage: str, seconds: float) -> None: ...


class QuietReporter:
    """Reports nothing."""

    def start_stage(self, stage: str) -> None: ...
    def report_share(self, stage: str, share: float) -> None: ...
    def end_stage(self, stage: str, seconds: float) -> None: ...


class PlainReporter:
    """One line when a stage starts and one when it has ended; for logs and pipes."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def start_stage(self, stage: str) -> None:
        print(f"{stage} ...", file=self._out, flush=True)

    def report_share(self, stage: str, share: float) -> None: ...

    def end_stage(self, stage: str, seconds: float) -> None:
        print(f"{stage}: {seconds:.1f} s", file=self._out, flush=True)


class TerminalReporter:
    """A rich bar per stage."""

    def __init__(self, console: Console) -> None:
        columns = (SpinnerColumn(), TextColumn("{task.description:<28}"), BarColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, console=console)
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._progress.stop()

    def start_stage(self, stage: str) -> None:
        self._tasks[stage] = self._progress.add_task(stage, total=1.0)

    def report_share(self, stage: str, share: float) -> None:
        if stage in self._tasks:
            self._progress.update(self._tasks[stage], completed=min(1.0, max(0.0, share)))

    def end_stage(self, stage: str, seconds: float) -> None:
        self.report_share(stage, 1.0)


class Stopwatch:
    """Times stages and informs the reporter; `timings_s` goes to report.json."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self.timings_s: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[Fraction]:
        """Time a stage; yield the function to call with the share done."""
        begun = time.perf_counter()
        self._reporter.start_stage(name)
        yield lambda share: self._reporter.report_share(name, share)
        seconds = time.perf_counter() - begun
        self.timings_s[name] = round(seconds, 3)
        self._reporter.end_stage(name, seconds)


@contextmanager
def report_progress(quiet: bool) -> Iterator[Reporter]:
    """Yield the reporter for the standard output: a bar on a terminal, plain lines otherwise, nothing when quiet."""
    if quiet:
        yield QuietReporter()
    elif sys.stdout.isatty():
        with TerminalReporter(Console()) as bars:
            yield bars
    else:
        yield PlainReporter(sys.stdout)
