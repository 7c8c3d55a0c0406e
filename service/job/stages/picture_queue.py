"""Pictures are drawn beside whatever comes next, by one thread: those who draw share fonts, those who compute do not
wait.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from service.job import files as job_files


class PictureQueue:
    """A context: pictures that are not begun when it ends are dropped."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="pictures")
        self._begun: list[Future[Any]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)

    def import_first(self, modules: Iterable[str]) -> None:
        """Import what pictures are drawn with before the first is asked for."""
        self._begun.append(self._thread.submit(lambda: [import_module(name) for name in modules]))

    def draw(self, path: Path, picture: Callable[[], bytes]) -> None:
        """Write what `picture` returns, some time before `finish` does."""
        self._begun.append(self._thread.submit(lambda: job_files.write_bytes(path, picture())))

    def raise_failures(self) -> None:
        """Raise what the first did that has failed so far."""
        while self._begun and self._begun[0].done():
            self._begun.pop(0).result()

    def finish(self) -> None:
        """Wait until all that was begun is written; raises what the first that failed did."""
        while self._begun:
            self._begun.pop(0).result()
