"""The disk under a journal, and its syncing. Tests use one that loses power."""

from __future__ import annotations

import contextlib
import errno
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from machines.clock import LOOK_S, Timeout

SYNC_EVERY_S = 0.5


def os_words(error: OSError) -> str:
    """Return an operating system's error in plain words."""
    words = {errno.ENOSPC: "no space left on the disk", errno.EDQUOT: "the disk quota is used up"}
    return words.get(error.errno or 0, (error.strerror or str(error)).lower())


class File(Protocol):
    def write(self, data: bytes) -> None: ...
    def sync(self) -> None: ...
    def close(self) -> None: ...


class Disk(Protocol):
    def make_folder(self, path: Path) -> None: ...
    def create(self, path: Path) -> File: ...
    def remove(self, path: Path) -> None: ...
    def sync_folder(self, path: Path) -> None: ...


class Syncer(Protocol):
    """Calls `File.sync` in time. `failure` has the message of a failed sync until the next `take`."""

    @property
    def failure(self) -> str: ...
    def take(self, file: File, when_safe: Callable[[], None]) -> None:
        """Sync this file from now on; `when_safe` is called after its first successful sync."""
        ...

    def note_written(self) -> None: ...
    def sync(self) -> None:
        """Wait until everything written is safe, or `failure` has the reason why it is not."""
        ...

    def hasten(self) -> None:
        """Request a sync soon, without waiting for it."""
        ...

    def let_go(self) -> None:
        """Sync and close the file, without waiting if that can take time."""
        ...


class RealFile:
    """Unbuffered: everything written survives the end of the process."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600)

    def write(self, data: bytes) -> None:
        done = os.write(self._descriptor, data)
        if done != len(data):
            raise OSError(errno.ENOSPC, "no space left on the disk")

    def sync(self) -> None:
        os.fsync(self._descriptor)

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


class RealDisk:
    def make_folder(self, path: Path) -> None:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.sync_folder(path.parent)

    def create(self, path: Path) -> File:
        return RealFile(path)

    def remove(self, path: Path) -> None:
        path.unlink()

    def sync_folder(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _describe_stall(waited_s: float) -> str:
    return f"the disk has not finished an fsync for {waited_s:.0f} s"


class ThreadSyncer:
    """One thread per journal. A disk that takes seconds for an fsync delays only this thread.

    timeout_s : of running time, until the disk counts as stalled; its owner reads `failure` many times a second
    """

    def __init__(
        self,
        every_s: float = SYNC_EVERY_S,
        timeout_s: float = 30.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._every_s = every_s
        self._timeout_s = timeout_s
        self._clock = clock
        self._lock = threading.Condition()
        self._file: File | None = None
        self._left: list[File] = []  # released files that must still be synced and closed
        self._when_safe: Callable[[], None] | None = None
        self._written = self._safe = 0  # counts of writes
        self._waiting: Timeout | None = None  # until everything written is safe
        self._failure = ""
        self._urgent = False
        self._thread: threading.Thread | None = None

    @property
    def failure(self) -> str:
        if self._failure:
            return self._failure
        waiting = self._waiting
        return _describe_stall(waiting.waited_s) if waiting is not None and waiting.is_over else ""

    def _begin_wait(self) -> Timeout:
        return Timeout(self._timeout_s, clock=self._clock)

    def take(self, file: File, when_safe: Callable[[], None]) -> None:
        with self._lock:
            self._file, self._when_safe, self._failure, self._waiting = file, when_safe, "", None
            self._safe = self._written
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="journal fsync", daemon=True)
                self._thread.start()
        self.note_written()

    def note_written(self) -> None:
        with self._lock:
            self._written += 1
            if self._waiting is None:
                self._waiting = self._begin_wait()
                self._lock.notify_all()

    def sync(self) -> None:
        with self._lock:
            wanted, file = self._written, self._file
            self._urgent = True
            self._lock.notify_all()
            timeout = self._begin_wait()
            while self._safe < wanted and not self._failure:
                if timeout.is_over:
                    self._failure = _describe_stall(timeout.waited_s)
                self._lock.wait(min(LOOK_S, self._timeout_s) / 2.0)
            assert file is self._file  # one thread writes and syncs; only waiting is shared

    def hasten(self) -> None:
        with self._lock:
            self._urgent = True
            self._lock.notify_all()

    def let_go(self) -> None:
        """Leave the rest to the thread: a caller that stops a mill must not wait for a disk."""
        with self._lock:
            if self._file is not None:
                self._left.append(self._file)
            self._file = self._thread = None
            self._lock.notify_all()

    def _run(self) -> None:
        while (work := self._take_next()) is not None:
            file, when_safe, reached = work
            failure = ""
            try:
                file.sync()
                if when_safe is not None:
                    when_safe()
            except OSError as error:
                failure = f"not safe on disk: {os_words(error)}"
            with self._lock:
                if file is self._file:
                    self._failure = failure or self._failure
                    self._when_safe = None if when_safe is self._when_safe else self._when_safe
                    self._safe = max(self._safe, reached)
                    self._waiting = None if self._written == self._safe else self._begin_wait()
                self._lock.notify_all()
        with self._lock:
            left = self._left.pop(0) if self._left else None
        if left is not None:
            with contextlib.suppress(OSError):  # ignored: the reader will see what is on disk
                left.sync()
            left.close()

    def _take_next(self) -> tuple[File, Callable[[], None] | None, int] | None:
        """Return the next file to sync: at once if a caller waits for it, else a while after it was written."""
        me = threading.current_thread()
        with self._lock:
            self._lock.wait_for(lambda: self._thread is not me or self._written > self._safe)
            self._lock.wait_for(lambda: self._urgent or self._thread is not me, self._every_s)
            self._urgent = False
            if self._thread is not me or self._file is None:
                return None
            return self._file, self._when_safe, self._written
