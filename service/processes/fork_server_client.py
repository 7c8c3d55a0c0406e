"""The worker's end of the fork server: starts it when needed, sends it orders and heartbeats, and learns which children
have ended.

One thread, the keeper, starts the fork server process and listens to it: the kernel ties a process to the thread that
started it, so that thread has to live as long.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from phrases.phrase import Phrase
from service.processes.fork_server import MESSAGE_BYTES
from service.processes.source_tree import python_path

_IDLE_S = 60.0
_ANSWER_S = 10.0


class ForkServerError(Exception):
    """There is no fork server, or it ended before a child was started."""


@dataclass(slots=True, eq=False)
class ForkedChild:
    """One stage's process as the fork server reports it. `gone`: no process of its group is left, or the server is
    dead.
    """

    number: int
    server: ForkServer
    pid: int = 0
    status: int | None = None
    silent: bool = False
    peak_mb: float = 0.0
    orphaned: bool = False  # the fork server died before it
    refused: str = ""
    answered: threading.Event = field(default_factory=threading.Event)
    gone: threading.Event = field(default_factory=threading.Event)

    def send_beat(self) -> None:
        """Send a heartbeat: the worker is alive and still owns its job."""
        self.server.send_beat(self)

    def give_up(self) -> None:
        """End the fork server, because it no longer reports on this child."""
        self.server.kill()


class ForkServer:
    """One fork server process, from its start to its end."""

    def __init__(self, environment: Mapping[str, str], entry: str) -> None:
        self.ready = threading.Event()
        self.over = threading.Event()
        self.threads = 0  # that it had after importing everything; 0: not there yet
        self.words = ""
        self.idle_since = time.monotonic()
        self.lock = threading.Lock()
        self._environment, self._entry = environment, entry
        self._process: subprocess.Popen[bytes] | None = None
        self._children: dict[int, ForkedChild] = {}
        self.closing = False
        self._line, self._its_line = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._line.settimeout(1.0)
        self._keeper = threading.Thread(target=self._keep, name="fork server keeper", daemon=True)
        self._keeper.start()

    def add(self, child: ForkedChild, message: dict[str, Any], files: list[int]) -> None:
        """Order a child. ForkServerError if this fork server takes no more."""
        with self.lock:
            if self.closing or self.over.is_set():
                raise ForkServerError(self.words)
            self._children[child.number] = child
        try:
            socket.send_fds(self._line, [json.dumps(message).encode()], files)
        except OSError as error:
            with self.lock:
                self._children.pop(child.number, None)
            raise ForkServerError(str(error)) from None

    def send_beat(self, child: ForkedChild) -> None:
        try:
            self._line.send(json.dumps({"beat": child.number}).encode(), socket.MSG_DONTWAIT)
        except OSError:
            return  # the pipe is full or the server is gone: both are noticed elsewhere

    def close(self) -> None:
        """Take no more children, let the present ones die, and end the server."""
        with self.lock:
            self.closing = True
        try:
            self._line.shutdown(socket.SHUT_RDWR)
        except OSError:
            return

    def kill(self) -> None:
        """Kill a server that does not answer: the kernel ends its children with it."""
        with self.lock:
            if self._process is not None:
                self._process.kill()

    def join(self) -> None:
        self._keeper.join()

    def _keep(self) -> None:
        try:
            self._process = self._start_process()
            self._its_line.close()
            self._listen()
        except OSError as error:
            self.words = Phrase("cannot start the stages' process: {cause}", cause=error.strerror or str(error))
        finally:
            self._end()

    def _start_process(self) -> subprocess.Popen[bytes]:
        one_thread = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        return subprocess.Popen(
            [
                sys.executable,
                "-m",
                "service.processes.fork_server",
                str(self._its_line.fileno()),
                str(os.getpid()),
                self._entry,
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=(self._its_line.fileno(),),
            env={**self._environment, **one_thread, "PYTHONPATH": python_path(), "MPLBACKEND": "Agg"},
            start_new_session=True,  # the worker alone handles Ctrl-C on the terminal
        )

    def _listen(self) -> None:
        while True:
            try:
                data = self._line.recv(MESSAGE_BYTES)
            except TimeoutError:
                if self._is_idle():
                    return
                continue
            except OSError:
                return
            if not data:
                return
            self._hear(json.loads(data))

    def _is_idle(self) -> bool:
        with self.lock:
            if not self.ready.is_set() or self._children or time.monotonic() < self.idle_since + _IDLE_S:
                return False
            self.closing = True
            return True

    def _hear(self, message: dict[str, Any]) -> None:
        match message:
            case {"ready": True}:
                self.idle_since = time.monotonic()
                self.ready.set()
            case {"warm": True, "threads": threads}:
                self.threads = threads
            case {"started": number, "pid": pid}:
                self._children[number].pid = pid
                self._children[number].answered.set()
            case {"not_started": number, "words": words}:
                child = self._forget(number)
                child.refused = words
                child.answered.set()
                child.gone.set()
            case {"ended": number, "status": status, "silent": silent, "peak_mb": peak_mb}:
                child = self._forget(number)
                child.status, child.silent, child.peak_mb = status, silent, peak_mb
                child.gone.set()

    def _forget(self, number: int) -> ForkedChild:
        with self.lock:
            self.idle_since = time.monotonic()
            return self._children.pop(number)

    def _end(self) -> None:
        """End all its processes; callers that wait for a child learn that it is orphaned."""
        self._line.close()
        self._its_line.close()
        if self._process is not None:
            code = _wait_for(self._process)
            self.words = self.words or Phrase("the stages' process ended (code {code})", code=code)
        with self.lock:
            self.over.set()
            self.ready.set()
            lost, self._children = list(self._children.values()), {}
        for child in lost:
            child.orphaned = True
            child.answered.set()
            child.gone.set()


def _wait_for(process: subprocess.Popen[bytes]) -> int:
    try:
        return process.wait(timeout=4.0)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


class ForkServerLink:
    """Uses the running fork server, or starts a new one. Any thread may call.

    entry     : `module:function` that its children run
    memory_mb : that each child may take
    """

    def __init__(self, environment: Mapping[str, str], entry: str, *, memory_mb: int) -> None:
        self._environment, self._entry, self._memory_mb = environment, entry, memory_mb
        self._lock = threading.Lock()
        self._server: ForkServer | None = None
        self._number = 0
        self._closed = False

    def begin(self) -> ForkServer:
        """Start a fork server if there is none, without waiting until it is ready."""
        with self._lock:
            if self._closed:
                raise ForkServerError("the worker is ending")
            if self._server is None or self._server.over.is_set() or self._server.closing:
                self._server = ForkServer(self._environment, self._entry)
            return self._server

    def start_child(self, server: ForkServer, files: list[int], *, silence_s: float) -> ForkedChild:
        """Start a child that carries out the order in the files; ForkServerError if it could not be started."""
        with self._lock:
            self._number += 1
            child = ForkedChild(self._number, server)
        server.add(child, {"start": child.number, "silence_s": silence_s, "memory_mb": self._memory_mb}, files)
        if not child.answered.wait(_ANSWER_S):
            server.kill()
            child.answered.wait()
        if child.pid == 0:
            raise ForkServerError(child.refused or server.words)
        return child

    def close(self) -> None:
        with self._lock:
            self._closed, server = True, self._server
        if server is not None:
            server.close()
            server.join()
