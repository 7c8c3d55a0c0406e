"""Stages as child processes: `StageProcesses.run` starts one in the fork server and supervises it to its end.

A cancelled, late or silent stage is killed with everything it started, and `run` returns only when nobody is left.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from phrases.phrase import Phrase
from service.errors import FailedError
from service.processes.fork_server_client import ForkedChild, ForkServerError, ForkServerLink
from service.server.worker.lease import SAFE_SHARE
from service.server.worker.process.supervision import (
    Crashed,
    Done,
    Failed,
    Refused,
    StageEnd,
    StageLog,
    Stopped,
    Supervision,
    Task,
)
from service.settings import ServerSettings

__all__ = ["STAGE_ENTRY", "Crashed", "Done", "Failed", "Refused", "StageEnd", "StageProcesses", "Stopped"]

STAGE_ENTRY = "service.server.worker.process.entry:run_stage"
_TICK_S = 0.1
_STARTS = 3


class StageProcesses:
    """Runs stages in killable child processes; several at a time, from any thread.

    entry : `module:function` called in the child as function(order, on_progress) -> result, both plain JSON
    """

    def __init__(self, settings: ServerSettings, *, entry: str = STAGE_ENTRY) -> None:
        if sys.platform != "linux":
            raise FailedError("stages run under Linux only: elsewhere a stopped job could leave processes behind")
        self._settings = settings
        self._link = ForkServerLink(settings.environment(), entry, memory_mb=settings.stage_memory_mb)

    def warm(self) -> None:
        """Begin to get ready for a stage; returns at once."""
        with contextlib.suppress(ForkServerError):  # it is ending
            self._link.begin()

    def close(self) -> None:
        """End every process; stages that run end as crashed, and none is started any more."""
        self._link.close()

    def run(
        self,
        order: Any,
        *,
        log: Path,
        on_progress: Callable[[float], None],
        stop: Callable[[], str | None],
    ) -> StageEnd:
        """Run one stage to its end; when this returns no process of it lives.

        order : a dataclass or mapping of plain values; log : what the stage prints is added to this file
        stop  : asked at least 5 times per second: "cancelled", "fenced" or None. A beat is passed on only after it
                has answered: as long as it hangs, so does the worker's claim, and the stage ends itself at 0.6 lease
        """
        with _Files(order, log) as files:
            child = self._start_child(files, stop)
            if not isinstance(child, ForkedChild):
                return child
            files.hand_over()
            task = Task(settings=self._settings, log=StageLog(log), on_progress=on_progress, stop=stop)
            return Supervision(child, files.words, task).follow()

    def _start_child(self, files: _Files, stop: Callable[[], str | None]) -> ForkedChild | StageEnd:
        """Start a child; a fork server that is not there yet is waited for."""
        words = ""
        for _ in range(_STARTS):
            try:
                server = self._link.begin()
                while not server.ready.wait(_TICK_S):
                    if reason := stop():
                        return Stopped(reason)
                return self._link.start_child(server, files.given, silence_s=SAFE_SHARE * self._settings.lease_s)
            except ForkServerError as error:
                words = str(error)
        return Crashed(Phrase("the stage could not be started: {cause}", cause=words))


class _Files:
    """The files of one child: what it is given, and the worker's end of its pipe of words."""

    def __init__(self, order: Any, log: Path) -> None:
        plain = dict(order) if isinstance(order, Mapping) else dataclasses.asdict(order)
        text = json.dumps(plain).encode()
        log.parent.mkdir(parents=True, exist_ok=True)
        self.given: list[int] = []
        self._own: list[int] = []
        try:
            self.given.append(os.memfd_create("order"))
            with open(self.given[0], "wb", closefd=False) as file:
                file.write(text)
            os.lseek(self.given[0], 0, os.SEEK_SET)
            self.words, its_words = os.pipe()
            self._own.append(self.words)
            self.given.append(its_words)
            os.set_blocking(self.words, False)
            self.given.append(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600))
        except BaseException:
            self.__exit__()
            raise

    def hand_over(self) -> None:
        """Close what the child has of its own: the pipe's end shall show when the child has closed it."""
        while self.given:
            os.close(self.given.pop())

    def __enter__(self) -> _Files:
        return self

    def __exit__(self, *_: object) -> None:
        self.hand_over()
        while self._own:
            os.close(self._own.pop())
