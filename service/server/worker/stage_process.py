"""Stages as child processes: `StageProcesses.run` starts one in the fork server and supervises it to its end: messages,
heartbeats, time, log, and requests to stop it. A cancelled, late or silent stage is killed with everything it started,
and `run` returns only when none of its processes is left.

The log is kept short: a stage that repeats a line for hours must not fill the disk. The process appends to the
file by itself, so the worker cannot shorten it without losing lines just written. Instead it frees the disk blocks of
the middle now and then, and removes the middle when no one writes any more. The first and the last lines show why a
stage went wrong.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machines.clock import Timeout
from phrases.phrase import Phrase
from service.errors import FailedError, InputError, PictureError, ServiceError, SpecError
from service.processes.child import ChildCrashed, ChildDied, Words, result_of
from service.processes.child_work import out_of_memory
from service.processes.fork_server_client import ForkedChild, ForkServerError, ForkServerLink
from service.processes.linux import give_back_blocks, list_living_members, signal_group, signal_stage
from service.settings import SAFE_SHARE, ServerSettings

_TICK_S = 0.1
_GRACE_S = 1.0  # between SIGTERM and SIGKILL
_REAP_S = 5.0  # a fork server that has not reported a dead child by then is stuck
_MEMORY_SHARE = 0.9  # a crash this close to the limit is blamed on the limit
MOST_LOG_BYTES = 1_000_000
HALF_LOG = MOST_LOG_BYTES // 2
CUT = b"\n... (cut here: the stage said more than 1 MB) ...\n"


@dataclass(frozen=True, slots=True)
class Done:
    """The stage has succeeded: the value that its function returned, as plain JSON."""

    result: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Refused:
    """The person's input cannot be used. Trying again would not help. `field`: key of the spec, or ""."""

    lines: tuple[str, ...]
    field: str = ""


@dataclass(frozen=True, slots=True)
class Failed:
    """The stage itself failed: a check, the disk, out of memory, out of time. Trying again would not help."""

    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Crashed:
    """The process ended without a result: by a signal, an exit, or a bug in the program. It may be tried again."""

    words: str


@dataclass(frozen=True, slots=True)
class Stopped:
    """The stage was stopped: by a cancel ("cancelled"), or because its worker may no longer own the job ("fenced")."""

    reason: str


StageEnd = Done | Refused | Failed | Crashed | Stopped
"""The possible ends of one try of one stage."""


class StageLog:
    """The log of a stage's process, in a file, which must exist."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._freed = HALF_LOG

    def look(self) -> None:
        """Check its size while it is being written."""
        end = self._path.stat().st_size - HALF_LOG
        if end > self._freed + MOST_LOG_BYTES:
            give_back_blocks(self._path, self._freed, end - self._freed)
            self._freed = end

    def end(self) -> None:
        """Finish the log when no one writes any more: keep its first and its last half."""
        size = self._path.stat().st_size
        if size > MOST_LOG_BYTES:
            with self._path.open("r+b") as file:
                file.seek(size - HALF_LOG)
                rest = file.read()
                file.truncate(HALF_LOG)
                file.seek(HALF_LOG)
                file.write(CUT + rest)


@dataclass(frozen=True, kw_only=True)
class Task:
    """The subject of one supervision."""

    settings: ServerSettings
    log: StageLog
    on_progress: Callable[[float], None]
    stop: Callable[[], str | None]


class Supervision:
    """Use once: `follow` returns the stage's end when no process of its group is left."""

    def __init__(self, child: ForkedChild, pipe: int, task: Task) -> None:
        self._child, self._task = child, task
        self._words = Words(pipe)
        self._time = Timeout(task.settings.stage_time_s)
        self._beaten_at = 0.0
        self._verdict: StageEnd | None = None
        self._term_at = self._closed_at = float("inf")

    def follow(self) -> StageEnd:
        try:
            while not self._child.gone.is_set():
                self._wait()
                self._judge()
                self._task.log.look()
        finally:
            self._leave_nobody()
        self._task.log.end()
        self._words.drain()
        return self._verdict or self._parse_last() or self._explain_unexpected()

    def _wait(self) -> None:
        """Wait for a message, the end of the messages, the child's end, or the next beat."""
        tick_s = min(_TICK_S, self._task.settings.lease_s / 20)
        if self._words.is_open:
            self._words.read(tick_s)
            self._closed_at = self._closed_at if self._words.is_open else time.monotonic()
        else:
            self._child.gone.wait(tick_s)
        if (share := self._words.take_share()) is not None and self._verdict is None:
            self._task.on_progress(share)

    def _judge(self) -> None:
        now = time.monotonic()
        if self._verdict is None:
            if reason := self._task.stop():
                self._end_with(Stopped(reason))
            elif self._time.is_over:
                self._end_with(Failed((_out_of_time(self._time.seconds),)))
            elif now > self._beaten_at + self._task.settings.lease_s / 20:
                self._beaten_at = now
                self._child.send_beat()
        overdue_s = now - _GRACE_S - min(self._term_at, self._closed_at)
        if overdue_s > 0:  # asked to end, or without its pipe, and still running
            signal_stage(self._child.pid, signal.SIGKILL)
        if overdue_s > _REAP_S:
            self._child.give_up()

    def _end_with(self, verdict: StageEnd) -> None:
        self._verdict, self._term_at = verdict, time.monotonic()
        signal_stage(self._child.pid, signal.SIGTERM)

    def _leave_nobody(self) -> None:
        """End every process, also after an error in the worker itself. Afterwards the fork server has reaped the group,
        or is dead.
        """
        if not self._child.gone.is_set():
            signal_stage(self._child.pid, signal.SIGKILL)
            if not self._child.gone.wait(_REAP_S):
                self._child.give_up()
                self._child.gone.wait()
        if self._child.orphaned:
            while list_living_members(self._child.pid):
                signal_group(self._child.pid, signal.SIGKILL)
                time.sleep(0.01)

    def _parse_last(self) -> StageEnd | None:
        try:
            return Done(result_of(self._words.last))
        except InputError as error:
            return Refused(error.lines, _field(error))
        except ServiceError as error:
            return Failed(error.lines)
        except ChildCrashed as error:
            return Crashed(str(error))
        except ChildDied:
            return None

    def _explain_unexpected(self) -> StageEnd:
        child = self._child
        if child.silent:
            return Stopped("fenced")
        if child.orphaned or child.status is None:
            return Crashed(Phrase("the process that starts the stages died, and this stage with it"))
        if child.peak_mb > _MEMORY_SHARE * self._task.settings.stage_memory_mb:
            return Failed((out_of_memory(self._task.settings.stage_memory_mb),))
        code = os.waitstatus_to_exitcode(child.status)
        if code >= 0:
            return Crashed(Phrase("the stage's process ended with code {code} and without a result", code=code))
        words = Phrase(
            "the stage's process was ended by signal {number} ({name})", number=-code, name=_signal_name(-code)
        )
        if code == -signal.SIGKILL:
            words = Phrase("{cause}: perhaps this computer is short of memory", cause=words)
        return Crashed(words)


def _field(error: InputError) -> str:
    match error:
        case PictureError():
            return "image"
        case SpecError() if error.problems:
            return f"spec.{error.problems[0][0]}"
    return ""


def _out_of_time(limit_s: float) -> Phrase:
    return Phrase("the stage took longer than {limit_s:g} s (CAUSTICMILL_STAGE_TIME_S)", limit_s=limit_s)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return Phrase("unknown")


__all__ = ["STAGE_ENTRY", "Crashed", "Done", "Failed", "Refused", "StageEnd", "StageProcesses", "Stopped"]

STAGE_ENTRY = "service.server.worker.stage_entry:run_stage"
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
        """Begin to prepare for a stage; return at once."""
        with contextlib.suppress(ForkServerError):  # it is ending
            self._link.begin()

    def close(self) -> None:
        """End every process; running stages end as crashed, and no more are started."""
        self._link.close()

    def run(
        self,
        order: Any,
        *,
        log: Path,
        on_progress: Callable[[float], None],
        stop: Callable[[], str | None],
    ) -> StageEnd:
        """Run one stage to its end; when this returns, none of its processes is alive.

        order : a dataclass or mapping of plain values; log : what the stage prints is added to this file
        stop  : called at least 5 times per second: "cancelled", "fenced" or None. A heartbeat is passed on only after
        it has answered: while it hangs, the claim is not renewed, and the stage ends itself after 0.6 of a lease
        """
        with _Files(order, log) as files:
            child = self._start_child(files, stop)
            if not isinstance(child, ForkedChild):
                return child
            files.hand_over()
            task = Task(settings=self._settings, log=StageLog(log), on_progress=on_progress, stop=stop)
            return Supervision(child, files.words, task).follow()

    def _start_child(self, files: _Files, stop: Callable[[], str | None]) -> ForkedChild | StageEnd:
        """Start a child; wait for the fork server if it is not ready."""
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
    """The files of one child: its input, and the worker's end of its pipe of messages."""

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
        """Close the worker's copies of the child's files, so that the end of the pipe shows when the child has closed
        it.
        """
        while self.given:
            os.close(self.given.pop())

    def __enter__(self) -> _Files:
        return self

    def __exit__(self, *_: object) -> None:
        self.hand_over()
        while self._own:
            os.close(self._own.pop())
