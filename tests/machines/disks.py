"""Disks that can be full or broken, a clock that a test moves, and a journal's syncer in simulated time."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path

from machines.journal.disk import SYNC_EVERY_S, File, RealDisk, RealFile, os_words

ROOM = 1 << 40


class Clock:
    def __init__(self, now_s: float = 0.0) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s


class FullDisk(RealDisk):
    """room: bytes that can still be written; before_write: what happens while a write is waited for."""

    room = ROOM
    sync_fails = False
    before_write: Callable[[], object] = staticmethod(lambda: None)

    def create(self, path: Path) -> RealFile:
        disk = self

        class File(RealFile):
            def write(self, data: bytes) -> None:
                disk.before_write()
                if disk.room < len(data):
                    super().write(data[: disk.room])
                    disk.room = 0
                    raise OSError(errno.ENOSPC, "No space left on device")
                disk.room -= len(data)
                super().write(data)

            def sync(self) -> None:
                if disk.sync_fails:
                    raise OSError(errno.EIO, "Input/output error")
                super().sync()

        if not self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return File(path)


class InlineSyncer:
    """Syncs within the call that writes, by the clock it is given: for simulated time."""

    def __init__(self, clock: Callable[[], float], every_s: float = SYNC_EVERY_S) -> None:
        self._clock = clock
        self._every_s = every_s
        self._file: File | None = None
        self._when_safe: Callable[[], None] | None = None
        self._synced_s = float("-inf")
        self._failure = ""

    @property
    def failure(self) -> str:
        return self._failure

    def take(self, file: File, when_safe: Callable[[], None]) -> None:
        self._file, self._when_safe, self._failure = file, when_safe, ""
        self.note_written()

    def note_written(self) -> None:
        if self._clock() >= self._synced_s + self._every_s:
            self.sync()

    def sync(self) -> None:
        if self._file is None:
            return
        self._synced_s = self._clock()
        try:
            self._file.sync()
            if self._when_safe is not None:
                self._when_safe()
                self._when_safe = None
        except OSError as error:
            self._failure = f"not safe on disk: {os_words(error)}"

    def hasten(self) -> None:
        self.sync()

    def let_go(self) -> None:
        self.sync()
        if self._file is not None:
            self._file.close()
        self._file = None
