"""The context of a stage: the job's spec, the folder, the results of earlier stages, and its own.

Theory of operation: stages hand files to one another. In the job server each runs in a process of its own and reads
them back; at the command line all run in one process and find on the `desk` what an earlier one has put there. Files
whose name begins with a dot are between stages only, so with a desk they are never written.
"""

from __future__ import annotations

import platform
import resource
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeVar

from machines.profile import MachineProfile
from phrases.phrase import Phrase, phrases_in
from service.job import files as job_files
from service.job.picture import OWN_PICTURE, PictureLimits
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob
from service.progress import Stopwatch

Part = Literal["optics", "passes"]
T = TypeVar("T")

THE_PICTURE = "{picture}"  # in a note: the picture's name, which only the last stage knows


class PictureQueue:
    """Draws pictures in one thread, so that the stage does not wait. One thread, because fonts are shared.

    A context manager: pictures that are not begun when it ends are dropped.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="pictures")
        self._begun: list[Future[Any]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)

    def import_first(self, modules: Iterable[str]) -> None:
        """Import the drawing libraries before the first picture is requested."""
        self._begun.append(self._thread.submit(lambda: [import_module(name) for name in modules]))

    def draw(self, path: Path, picture: Callable[[], bytes]) -> None:
        """Write what `picture` returns, some time before `finish` does."""
        self._begun.append(self._thread.submit(lambda: job_files.write_bytes(path, picture())))

    def raise_failures(self) -> None:
        """Raise the error of the first picture that has failed so far."""
        while self._begun and self._begun[0].done():
            self._begun.pop(0).result()

    def finish(self) -> None:
        """Wait until all pictures are written; raise the error of the first that failed."""
        while self._begun:
            self._begun.pop(0).result()


@dataclass(frozen=True, kw_only=True)
class StageContext:
    """One stage at work.

    number             : of the pass, for a stage that mills one
    so_far             : report.json as far as earlier stages have made it; report: what this stage adds
    earlier_notes      : warnings of earlier stages by part of the job; notes: those of this stage
    files              : names of the job's files that need not stand in the folder
    picture            : where the person's picture is; picture_name: on the setup sheet
    picture_called     : in messages; None: by its path
    picture_queue      : draws the pictures
    plans              : folder of plans made before; None: no plan is kept
    desk               : values by file name, shared by the stages of one process; None: stages exchange files only
    """

    job: ResolvedJob
    folder: Path
    watch: Stopwatch
    picture_queue: PictureQueue
    number: int = 0
    so_far: dict[str, Any] = field(default_factory=dict)
    earlier_notes: dict[str, list[str]] = field(default_factory=dict)
    files: frozenset[str] = frozenset()
    picture: Path = Path()
    picture_name: str = ""
    picture_called: str | None = None
    limits: PictureLimits = OWN_PICTURE
    plans: Path | None = None
    desk: dict[str, Any] | None = None
    report: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    def note(self, part: Part, sentence: Phrase) -> None:
        self.notes.setdefault(part, []).append(sentence)

    def finish_report(self) -> dict[str, Any]:
        """Return the report with the phrases that it and the notes hold."""
        self.report["phrases"] = {**self.report.get("phrases", {}), **phrases_in((self.report, self.notes))}
        return self.report

    @property
    def spec(self) -> JobSpec:
        return self.job.spec

    @property
    def machine(self) -> MachineProfile:
        return self.job.machine

    @property
    def is_shown(self) -> bool:
        """Whether files for the operator page are wanted; folders of the command line have none."""
        return self.desk is None

    def save(self, name: str, data: bytes) -> None:
        job_files.write_bytes(self.folder / name, data)

    def draw(self, name: str, picture: Callable[[], bytes]) -> None:
        """Save what `picture` returns, in the drawing thread.

        name : of a row of `service.job.report.pictures`, or of another file that `service.job.files` knows
        """
        assert job_files.is_known(name), name
        self.picture_queue.draw(self.folder / name, picture)

    def hand_over(self, name: str, value: T, encode: Callable[[T], bytes]) -> None:
        """Hand this value to a later stage: in a file of this name, if that is one of the job's or there is no desk."""
        if self.desk is not None:
            self.desk[name] = value
        if self.desk is None or not name.startswith("."):
            self.save(name, encode(value))

    def receive_if_there(self, name: str, decode: Callable[[Path], T]) -> T | None:
        """Return the value that an earlier stage handed over; None if there is none, as in some jobs."""
        is_there = (self.desk is not None and name in self.desk) or (self.folder / name).is_file()
        return self.receive(name, decode) if is_there else None

    def receive(self, name: str, decode: Callable[[Path], T]) -> T:
        """Return the value that an earlier stage handed over."""
        if self.desk is not None and name in self.desk:
            value: T = self.desk[name]
            return value
        return decode(self.folder / name)


def versions() -> dict[str, str]:
    """Return the versions of this program and of the libraries that its numbers depend on."""
    names = ("causticmill", "numpy", "scipy", "numba", "pillow")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def peak_rss_mb() -> float:
    """Return the largest memory this process has held, in MB (the unit of ru_maxrss is bytes on macOS, else KiB)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1 if sys.platform == "darwin" else 1024) / 1e6, 1)
