"""The folder of one mill: whose it is, and what lies in it.

lock                       held by the one process that owns the mill
runs/<id>/preflight.json   what is known of the program
runs/<id>/journal-*.log    what happened to the run
"""

from __future__ import annotations

import calendar
import fcntl
import os
import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from machines.errors import JournalError, NotAllowedError
from machines.journal.disk import os_words
from machines.journal.journal import JournalContent, read_journal
from machines.preflight.preflight import Preflight
from machines.runs import LIVE, RunState, RunView

_ID = re.compile(r"[0-9A-Za-z][0-9A-Za-z-]{0,79}")
_TIME = "%Y%m%d-%H%M%S"
_MADE = re.compile(r"20[0-9]{2}(0[1-9]|1[0-2])(0[1-9]|[12][0-9]|3[01])-([01][0-9]|2[0-3])[0-5][0-9][0-5][0-9]-.*")


class FolderLock:
    """The folder belongs to this process until `release`, or until the process ends, however it ends."""

    def __init__(self, folder: Path) -> None:
        path = folder / "lock"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise JournalError(
                f"folder {folder}: {os_words(error)}; the journal needs one that can be written"
            ) from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.pread(self._descriptor, 32, 0).decode("ascii", "replace").strip()
            os.close(self._descriptor)
            words = f" (process {owner})" if owner else ""
            raise NotAllowedError(
                f"folder {folder}: another agent or stream{words} owns this mill; stop that one first"
            ) from None
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


class RunFolders:
    """The runs of one mill on disk."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "runs"

    def path(self, run_id: str) -> Path:
        if not _ID.fullmatch(run_id):
            raise NotAllowedError(f"'{run_id[:40]}' is not the id of a run")
        return self.folder / run_id

    def new_id(self, wall_s: float, sha256: str) -> str:
        """Unique in this folder, and sorts behind all that are there, even after the wall clock was set back."""
        newest_s = max((calendar.timegm(time.strptime(name[:15], _TIME)) for name in self._names()), default=0)
        return time.strftime(_TIME, time.gmtime(max(wall_s, newest_s + 1))) + f"-{sha256[:6]}"

    def _names(self) -> list[str]:
        if not self.folder.is_dir():
            return []
        return [path.name for path in self.folder.iterdir() if _MADE.fullmatch(path.name)]

    def remove(self, run_id: str) -> bool:
        """A run leaves the disk, its journal first; False where something of it stays."""
        folder = self.path(run_id)
        try:
            for path in (*sorted(folder.glob("journal-*.log")), *sorted(folder.glob("preflight.*"))):
                path.unlink()
            folder.rmdir()
        except OSError:
            return False
        return True

    def save_facts(self, run_id: str, facts: Preflight) -> None:
        """preflight.json, whole or not at all."""
        folder = self.path(run_id)
        part = folder / "preflight.part"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with part.open("w", encoding="utf-8") as file:
                file.write(facts.to_json())
                file.flush()
                os.fsync(file.fileno())
            part.replace(folder / "preflight.json")
        except OSError as error:
            raise JournalError(f"folder {folder}: {os_words(error)}") from error

    def load_facts(self, run_id: str) -> Preflight:
        path = self.path(run_id) / "preflight.json"
        try:
            return Preflight.from_json(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise JournalError(f"{path}: {os_words(error)}; the run cannot go on without it") from error
        except (ValueError, KeyError, TypeError) as error:
            raise JournalError(f"{path}: damaged ({error}); the run cannot go on without it") from error

    def found(self) -> Iterator[tuple[str, JournalContent]]:
        """Every run with a readable journal, oldest first."""
        if not self.folder.is_dir():
            return
        for path in sorted(self.folder.iterdir()):
            if path.is_dir() and _ID.fullmatch(path.name) and (content := read_journal(path)) is not None:
                yield path.name, content


def view_of(record: Mapping[str, Any], *, time_left_s: float | None = None) -> RunView:
    """A run's record in the journal as others see it."""
    return RunView(
        id=str(record["id"]),
        name=str(record.get("name", "")),
        program=str(record.get("sha256", "")),
        path=str(record.get("path", "")),
        state=RunState(record["state"]),
        words=str(record.get("words", "")),
        operator=str(record.get("operator", "")),
        lines=int(record.get("lines", 0)),
        bytes=int(record.get("bytes", 0)),
        sent_line=int(record.get("sent_line") or 0),
        executed_line=int(record.get("executed_line") or 0),
        time_s=float(record.get("time_s", 0.0)),
        time_left_s=time_left_s,
        created_s=float(record.get("created_s", 0.0)),
        started_s=record.get("started_s"),
        ended_s=record.get("ended_s"),
        recoveries=int(record.get("recoveries", 0)),
        warnings=tuple(record.get("warnings", ())),
    )


def left_alone(record: Mapping[str, Any]) -> bool:
    """The journal says that the run is live: whoever wrote it has gone without saying so."""
    return RunState(record["state"]) in LIVE
