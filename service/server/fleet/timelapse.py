"""Pictures of the camera beside a mill, kept with the run that it shows: DATA/timelapse/RUN/SECONDS.jpg.

A live run gets a picture at each look of the fleet's watch, 10 s apart. When it has MOST_PICTURES, or MOST_BYTES,
every second one goes and the next ones come half as often, so that a run of an hour and one of a week need equal room.
Only the files are kept; their names give the time. A full disk loses pictures, nothing else.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from service.processes.files import open_whole

MOST_PICTURES = 300
MOST_BYTES = 100_000_000  # of one run
KEPT_RUNS = 10  # the newest ones
_EARLY = 0.9  # of the distance between two pictures: the watch is not exact


class Timelapses:
    """The pictures in one folder. Calls wait for the disk.

    clock : seconds since 1970
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = time.time) -> None:
        self._folder = folder
        self._clock = clock

    def is_due(self, run_id: str) -> bool:
        """Return whether the run has no picture yet, or none since the usual time between two of them."""
        taken = self.list_times(run_id)
        if len(taken) < 2:
            return True
        return self._clock() - taken[-1] >= _EARLY * (taken[-1] - taken[0]) / (len(taken) - 1)

    def keep(self, run_id: str, picture: bytes) -> None:
        """Keep a present picture, and make room for it. OSError"""
        folder = self._folder / run_id
        is_new = not folder.is_dir()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with open_whole(folder / f"{int(self._clock())}.jpg", 0o600) as file:
            file.write(picture)
        self._thin_out(run_id)
        if is_new:
            self._drop_old_runs()

    def list_times(self, run_id: str) -> list[int]:
        """Return when pictures of this run were taken, seconds since 1970, oldest first."""
        return sorted(int(path.stem) for path in (self._folder / run_id).glob("*.jpg") if path.stem.isdecimal())

    def read(self, run_id: str, at_s: int) -> bytes | None:
        """Return one picture; None if there is none."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return self._path(run_id, at_s).read_bytes()
        return None

    def _thin_out(self, run_id: str) -> None:
        taken = self.list_times(run_id)
        size = sum(self._path(run_id, at_s).stat().st_size for at_s in taken)
        if len(taken) > MOST_PICTURES or size > MOST_BYTES:
            for at_s in taken[1::2]:
                self._path(run_id, at_s).unlink()

    def _drop_old_runs(self) -> None:
        folders = sorted(self._folder.iterdir(), key=lambda path: path.stat().st_mtime)
        for old in folders[:-KEPT_RUNS]:
            shutil.rmtree(old, ignore_errors=True)

    def _path(self, run_id: str, at_s: int) -> Path:
        return self._folder / run_id / f"{at_s}.jpg"
