"""The runs of one mill: the lock of their folder, its contents, and the mill's current run.

lock                       held by the one process that owns the mill
runs/<id>/preflight.json   facts about the program runs/<id>/journal-*.log    the history of the run
"""

from __future__ import annotations

import calendar
import fcntl
import os
import re
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from machines.driver import MillStatus
from machines.errors import JournalError, MillCode, NotAllowedError
from machines.gcode.program import ProgramReader
from machines.grbl.settings import ControllerSettings
from machines.journal.disk import os_words
from machines.journal.journal import Journal, JournalContent, read_journal
from machines.mill.run import OWNER_LOST, Run
from machines.preflight.preflight import AT_PRESENT_ZERO, Preflight
from machines.recovery.needs import position_doubt
from machines.recovery.plan_model import Present
from machines.runs import RECOVERABLE, RunReport, RunState
from phrases.phrase import Phrase

KEPT_RUNS = 200
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
                Phrase(
                    "folder {folder}: {reason}; the journal needs a writable folder",
                    folder=folder,
                    reason=os_words(error),
                )
            ) from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.pread(self._descriptor, 32, 0).decode("ascii", "replace").strip()
            os.close(self._descriptor)
            who = Phrase("another agent or stream")
            if owner:
                who = Phrase("another agent or stream (process {process})", process=owner)
            words = Phrase("folder {folder}: {who} owns this mill; stop it first", folder=folder, who=who)
            raise NotAllowedError(words) from None
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
            raise NotAllowedError(Phrase("'{run}' is not the id of a run", run=run_id[:40]))
        return self.folder / run_id

    def new_id(self, wall_s: float, sha256: str) -> str:
        """Return a name that is unique in this folder and sorts after all present ones, even after the wall clock was
        set back.
        """
        newest_s = max((calendar.timegm(time.strptime(name[:15], _TIME)) for name in self._names()), default=0)
        return time.strftime(_TIME, time.gmtime(max(wall_s, newest_s + 1))) + f"-{sha256[:6]}"

    def _names(self) -> list[str]:
        if not self.folder.is_dir():
            return []
        return [path.name for path in self.folder.iterdir() if _MADE.fullmatch(path.name)]

    def remove(self, run_id: str) -> bool:
        """Remove a run from the disk, its journal first; False if a part of it stays."""
        folder = self.path(run_id)
        try:
            for path in (*sorted(folder.glob("journal-*.log")), *sorted(folder.glob("preflight.*"))):
                path.unlink()
            folder.rmdir()
        except OSError:
            return False
        return True

    def save_facts(self, run_id: str, facts: Preflight) -> None:
        """Write preflight.json, completely or not at all."""
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
            raise JournalError(Phrase("folder {folder}: {reason}", folder=folder, reason=os_words(error))) from error

    def load_facts(self, run_id: str) -> Preflight:
        path = self.path(run_id) / "preflight.json"
        try:
            return Preflight.from_json(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise JournalError(
                Phrase("{path}: {reason}; the run cannot go on without it", path=path, reason=os_words(error))
            ) from error
        except (ValueError, KeyError, TypeError) as error:
            raise JournalError(
                Phrase("{path}: damaged ({error}); the run cannot go on without it", path=path, error=error)
            ) from error

    def list_runs(self) -> Iterator[tuple[str, JournalContent]]:
        """Yield every run with a readable journal, oldest first."""
        if not self.folder.is_dir():
            return
        for path in sorted(self.folder.iterdir()):
            if path.is_dir() and _ID.fullmatch(path.name) and (content := read_journal(path)) is not None:
                yield path.name, content


class RunStore:
    """All runs of one mill. The folder is this process's until `close`.

    active : the current run: the live one, else the last one
    """

    def __init__(
        self,
        folder: Path,
        wall_clock: Callable[[], float],
        open_journal: Callable[[Path], Journal],
        say: Callable[..., None],
    ) -> None:
        self._wall = wall_clock
        self._open_journal = open_journal
        self._say = say
        self._folders = RunFolders(folder)
        self._runs: dict[str, Run] = {}
        self.active: Run | None = None
        self._lock = FolderLock(folder)
        try:
            self._find_runs()
        except BaseException:
            self._lock.release()
            raise

    def views(self, most: int | None = None) -> tuple[RunReport, ...]:
        """Return the newest runs as others see them, newest first."""
        return tuple(run.view for run in islice(reversed(self._runs.values()), most))

    def get(self, run_id: str) -> Run:
        run = self._runs.get(run_id)
        if run is None:
            raise NotAllowedError(Phrase("this mill has no such run"))
        return run

    @property
    def live(self) -> Run | None:
        return self.active if self.active is not None and self.active.live else None

    def recoverable(self) -> list[Run]:
        return [run for run in self._runs.values() if run.state in RECOVERABLE]

    def park(
        self, program: Preflight, path: Path, name: str, *, lift_mm: float | None = None, lifted_from: str = ""
    ) -> Run:
        """Add a run that waits for its start. lift_mm, lifted_from : as in `RunReport`"""
        run_id = self._folders.new_id(self._wall(), program.sha256)
        self._folders.save_facts(run_id, program)
        record = {
            "id": run_id, "name": name, "sha256": program.sha256, "path": str(path.absolute()), "lines": program.lines,
            "bytes": program.bytes, "time_s": program.time_s, "timeline": program.timeline, "profile": program.profile,
            "created_s": round(self._wall(), 3), "lift_mm": lift_mm, "lifted_from": lifted_from,
            "warnings": list(program.warnings), "state": RunState.PARKED.value, "executed_line": 0,
            "travel_in_doubt": any(one.startswith(AT_PRESENT_ZERO) for one in program.warnings),
        }  # fmt: skip
        run = self._make_run(run_id, {"id": run_id, "state": RunState.PARKED.value})
        run.write("parked", **record)
        run.journal.hasten()
        run.facts, run.reader = program, ProgramReader(path, program.index)
        self._runs[run_id] = run
        if self.live is None:
            if self.active is not None:
                self.active.let_go()
            self.active = run
        self._say("run", f"{name}: parked", code=MillCode.RUN_PARKED, values={"name": name})
        self._forget_old_runs()
        return run

    def let_rest(self, run: Run) -> None:
        """Release files and index of a run that is not the current one."""
        if run is not self.active:
            run.let_go()

    def close(self) -> None:
        for run in self._runs.values():
            run.close()
        self._lock.release()

    def _make_run(self, run_id: str, record: dict[str, Any]) -> Run:
        return Run(
            record,
            lambda: self._open_journal(self._folders.path(run_id)),
            lambda: self._folders.load_facts(run_id),
        )

    def _find_runs(self) -> None:
        left: Run | None = None
        for run_id, content in self._folders.list_runs():
            run = self._make_run(run_id, dict(content.state))
            self._runs[run_id] = run
            if content.torn:
                run.record["torn"] = content.torn
                self._say("journal", Phrase("{run}: {torn}", run=run.view.name or run_id, torn=content.torn))
            if run.live:  # the process that wrote that has died
                values = {"state": run.record["state"]}
                words = Phrase("the agent ended while the run was {state}", state=run.state.words)
                run.write("run", state=RunState.INTERRUPTED.value, words=words, code=MillCode.OWNER_LOST, values=values,
                          found_s=round(self._wall(), 3),
                          adrift="" if run.record.get("restarted") else OWNER_LOST)  # fmt: skip
                run.journal.sync()
                self._say("run", f"{run.view.name}: interrupted ({words}); nothing goes on by itself",
                          code=MillCode.RUN_LEFT, values={"name": run.view.name, **values})  # fmt: skip
                left = run
            run.let_go()
            self.active = left or run

    def _forget_old_runs(self) -> None:
        """Remove finished runs beyond the newest KEPT_RUNS from the disk, but none that could still be recovered."""
        old = [run for run in list(self._runs.values())[:-KEPT_RUNS] if run is not self.active]
        for run in old:
            if run.state is RunState.FINISHED or (run.state is RunState.ABORTED and not run.record.get("started_s")):
                run.let_go()
                if self._folders.remove(run.id):
                    del self._runs[run.id]

    # ------------------------------------------------------------------ events between programs

    def note_restart(self) -> None:
        """Note for all recoverable runs that the controller has lost its position."""
        for run in self.recoverable():
            run.write("restarted", restarted=True)
            self.let_rest(run)

    def note_reset(self, status: MillStatus, parser_state: str | None, settings: ControllerSettings | None) -> None:
        """Note the mill's position after a reset that kept the count, for runs whose position was not in doubt.

        From then on the place alone proves the position: the reset has cleared the other proof, feed and spindle.
        """
        for run in [*self.recoverable(), *([self.live] if self.live is not None else [])]:
            present = Present.of_run(run.record, status, parser_state, settings)
            if status.machine_mm is not None and not position_doubt(run.record, present):
                run.write("reset", stood_mm=status.machine_mm)
                self.let_rest(run)

    def note_frame_change(self) -> None:
        """Note for all recoverable runs that a setting on which their position depends has changed."""
        for run in self.recoverable():
            run.write("frame", reframed=True)
            self.let_rest(run)

    def note_trust(self, settings: ControllerSettings | None) -> None:
        """Note that a person has confirmed the position, with the present settings."""
        known = {} if settings is None else {"settings": settings.to_dict()}
        for run in self.recoverable():
            run.write("trusted", reframed=False, **known)
            self.let_rest(run)

    def note_zero(self, axes: str) -> None:
        """Note that a person has set the work zero of these axes anew."""
        for run in self.recoverable():
            vouched = "".join(sorted({*str(run.record.get("zeroed", "")), *axes}))
            run.write("zeroed", zeroed=vouched)
            self.let_rest(run)
        for run in (one for one in self._runs.values() if one.state is RunState.PARKED):
            run.write("zeroed", warnings=run.lasting_warnings, travel_in_doubt=False)  # its start asks again

    def note_touch_off(self) -> None:
        for run in self._to_touch_off():
            run.write("touched off", touch_off="")
            self.let_rest(run)

    def needs(self) -> tuple[Phrase, ...]:
        """Return what a person has to do before the next start, in words."""
        if self.live is not None:
            return ()
        return tuple(Phrase("re-probe Z: {why}", why=run.record["touch_off"]) for run in self._to_touch_off()[-1:])

    def _to_touch_off(self) -> list[Run]:
        return [run for run in self._runs.values() if run.record.get("touch_off")]
