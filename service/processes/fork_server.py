"""The fork server: a warm process with one thread that forks a child for each stage, monitors it and reaps it.

Theory of operation: numpy, numba and our own modules take a second to import, so they are imported once, here, before
any fork; modules that only some stages need (LATER of the entry's module) are imported piece by piece while the server
is idle, and a child that needs them earlier imports them itself. A process can be forked safely only while it has one
thread, so nothing here starts one (OPENBLAS_NUM_THREADS is 1, no kernel runs). The worker sends orders and heartbeats
over a socket; heartbeats are passed on to the children. Each child leads its own group; descendants that lose their
parent are adopted (subreaper). When a child has ended, or was silent for too long, the rest of its group is killed, and
its end is reported only when none of the group is left. The leader is waited for only after its group was signalled, so
its process id cannot belong to another process. When the worker ends, the socket closes, and everything here ends.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
from dataclasses import dataclass
from typing import Any, NoReturn

from service.processes.child_work import ChildOrder, find_entry, run_child
from service.processes.kernel_cache import use_current_kernels
from service.processes.linux import (
    adopt_orphans,
    die_with_parent,
    give_way,
    name_process,
    own_children,
    signal_group,
    signal_stage,
    thread_count,
)

MESSAGE_BYTES = 65536
FILES = 3  # descriptors that come with an order: the order itself, the pipe of messages, the log
_REAP_S = 0.01
_ENDING_S = 2.0  # a process in a disk access may take longer: the kernel ends it later


@dataclass(slots=True)
class _Stage:
    number: int
    pid: int
    beats: int
    silence_s: float
    last_beat_at: float
    silent: bool = False
    status: int | None = None
    peak_mb: float = 0.0

    def is_overdue(self) -> bool:
        return time.monotonic() >= self.last_beat_at + self.silence_s


class _Loop:
    def __init__(self, line: socket.socket, entry: str) -> None:
        self._line = line
        self._entry = entry
        self._later = [*getattr(importlib.import_module(entry.partition(":")[0]), "LATER", ())][::-1]
        self._stages: dict[int, _Stage] = {}  # by process id
        self._pid = os.getpid()
        self._is_ending = False
        self._wakers = socket.socketpair()  # kept open as long as signals may come

    def serve(self) -> None:
        """Serve until the worker closes its end or has ended, or a SIGTERM arrives."""
        wake, woken = self._wakers
        for end in self._wakers:
            end.setblocking(False)
        signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGTERM, self._on_sigterm)
        self._send({"ready": True})
        poll = select.poll()
        poll.register(self._line, select.POLLIN)
        poll.register(wake, select.POLLIN)
        while not self._is_ending:
            ready = {number for number, _ in poll.poll(self._timeout_s() * 1000)}
            if not ready:
                self._import_one_more()
            if wake.fileno() in ready:
                with contextlib.suppress(BlockingIOError):
                    wake.recv(4096)
            if self._line.fileno() in ready and not self._listen():
                return
            self._kill_the_silent()
            self._reap()

    def _on_sigterm(self, *_: object) -> None:
        """Only note the signal: an interrupted import, or an interrupted end, must not be entered a second time."""
        if os.getpid() != self._pid:  # a child that got the signal before it had set itself up
            os._exit(128 + signal.SIGTERM)
        self._is_ending = True

    def end(self) -> NoReturn:
        """End all children."""
        for stage in self._stages.values():
            signal_stage(stage.pid, signal.SIGKILL)
        until = time.monotonic() + _ENDING_S
        with contextlib.suppress(ChildProcessError):  # none is left
            while time.monotonic() < until:
                for pid in own_children():  # a process that has left its group is adopted when its parent is dead
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                while os.waitpid(-1, os.WNOHANG)[0]:
                    continue
                time.sleep(_REAP_S)
        os._exit(0)

    def _import_one_more(self) -> None:
        if self._later:
            importlib.import_module(self._later.pop())
            if not self._later:
                gc.freeze()
                self._send({"warm": True, "threads": thread_count()})

    def _timeout_s(self) -> float:
        if self._later:
            return 0.0
        if any(stage.status is not None for stage in self._stages.values()):
            return _REAP_S
        now = time.monotonic()
        return max(
            0.0, min((s.last_beat_at + s.silence_s - now for s in self._stages.values() if not s.silent), default=60.0)
        )

    def _listen(self) -> bool:
        """Handle one message; False: the worker has ended."""
        try:
            data, files, _, _ = socket.recv_fds(self._line, MESSAGE_BYTES, FILES)
        except InterruptedError:
            return True
        except OSError:
            return False
        if not data:
            return False
        for file in files:
            os.set_inheritable(file, False)
        message = json.loads(data)
        if "beat" in message:
            self._pass_beat(message["beat"])
        else:
            self._start(message, files)
        return True

    def _pass_beat(self, number: int) -> None:
        for stage in self._stages.values():
            if stage.number == number:
                stage.last_beat_at = time.monotonic()
                with contextlib.suppress(OSError):  # the child is busy, or has ended
                    os.write(stage.beats, b".")

    def _start(self, message: dict[str, Any], files: list[int]) -> None:
        number, silence_s = message["start"], message["silence_s"]
        beats, beats_in = os.pipe()
        os.set_blocking(beats_in, False)
        given = ChildOrder(
            parent=self._pid, entry=self._entry, memory_mb=message["memory_mb"], silence_s=silence_s,
            order=files[0], words=files[1], log=files[2], beats=beats,
        )  # fmt: skip
        begun = time.monotonic()  # before the child itself counts: it must not end first and look like a crash
        try:
            pid = os.fork()
        except OSError as error:
            os.close(beats_in)
            self._send({"not_started": number, "words": str(error.strerror)})
        else:
            if pid == 0:
                run_child(given)
            self._stages[pid] = _Stage(number, pid, beats_in, silence_s, begun)
            self._send({"started": number, "pid": pid})
        for file in (*files, beats):
            os.close(file)

    def _kill_the_silent(self) -> None:
        for stage in self._stages.values():
            if not stage.silent and stage.status is None and stage.is_overdue():
                stage.silent = True
                signal_stage(stage.pid, signal.SIGKILL)

    def _reap(self) -> None:
        """Reap dead processes, kill those that outlive their leader or have left their group, and report the stages
        whose groups are gone.
        """
        while (dead := _find_dead()) is not None:
            if (stage := self._stages.get(dead)) is not None:
                signal_group(dead, signal.SIGKILL)
                _, stage.status, usage = os.wait4(dead, 0)
                stage.silent = stage.silent or stage.is_overdue()  # by its own count
                stage.peak_mb = usage.ru_maxrss * 1024 / 1e6
            else:
                os.waitpid(dead, 0)
        ended = [stage for stage in self._stages.values() if stage.status is not None]
        if not ended or self._kill_strays():
            return
        for stage in ended:
            if not signal_group(stage.pid, signal.SIGKILL):
                self._report(stage)

    def _kill_strays(self) -> bool:
        """Kill adopted processes that belong to the group of no stage; return whether there were any."""
        strays = [pid for pid in own_children() if pid not in self._stages and _group(pid) not in self._stages]
        for pid in strays:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        return bool(strays)

    def _report(self, stage: _Stage) -> None:
        del self._stages[stage.pid]
        os.close(stage.beats)
        self._send({"ended": stage.number, "status": stage.status, "silent": stage.silent, "peak_mb": stage.peak_mb})

    def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # the worker has ended: the next read shows it
            self._line.send(json.dumps(message).encode())


def _find_dead() -> int | None:
    """Find a child that has ended and was not waited for, without waiting for it."""
    try:
        found = os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return None
    return found.si_pid if found is not None else None


def _group(pid: int) -> int:
    try:
        return os.getpgid(pid)
    except ProcessLookupError:
        return -1


def main() -> None:
    """Run the fork server. Arguments: the socket, the worker's process id, the function that does a stage's work."""
    line, worker, entry = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    name_process("cm-forkserver")
    die_with_parent(worker)  # at once, even if an import waits for something
    give_way()
    use_current_kernels()
    gc.disable()  # everything that importing creates stays
    find_entry(entry)
    gc.freeze()
    gc.enable()
    adopt_orphans()
    loop = _Loop(socket.socket(fileno=line), entry)
    die_with_parent(worker, signal.SIGTERM)
    loop.serve()
    loop.end()


if __name__ == "__main__":
    main()
