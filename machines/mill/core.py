"""What a mill's owner knows: link, log, runs, and the snapshot that others see. Changes nothing on the mill."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from machines.driver import Command, Driver, MillStatus, Triple
from machines.errors import NotAllowedError
from machines.journal.journal import Journal
from machines.mill.files import FolderLock, RunFolders, left_alone
from machines.mill.link import NO_MILL, MillLink
from machines.mill.log import MillLog
from machines.mill.orders import NOBODY, Caller, OrderGate, Permit
from machines.mill.run import Run
from machines.mill.standing import OWNER_LOST, Standstill
from machines.mill.view import MillSnapshot
from machines.recovery.planning import Reentry
from machines.runs import RECOVERABLE, RunState, RunView

SHOWN_RUNS = 100
KEPT_RUNS = 200


class MillCore:
    """One mill and the folder its runs live in."""

    def __init__(
        self,
        *,
        name: str,
        connect: Callable[[], Driver],
        folder: Path,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        reentry: Reentry | None = None,
        open_journal: Callable[[Path], Journal] = Journal,
        pause: Callable[[float], object] | None = None,
        orders: OrderGate | None = None,
    ) -> None:
        self.name = name
        self._clock = clock
        self._wall = wall_clock
        self._reentry = reentry or Reentry()
        self._open_journal = open_journal
        self._log = MillLog(wall_clock)
        self._say = self._log.say
        self._link = MillLink(connect, clock, pause, self._say)
        self.orders = orders or OrderGate(wall_clock=wall_clock)
        self._permit: Permit | None = None  # of the order that is being carried out
        self._caller = NOBODY
        self._commander: tuple[Command, Caller] | None = None  # the last command, and whose it was
        self._look_at_s = float("-inf")
        self._hold_asked = False
        self._abort_asked = False
        self._recovering = False
        self._parser_state: str | None = None
        self._jog_from_mm: Triple | None = None  # machine coordinates
        self._zeroed = ""
        self._homed = False
        self._standstill = Standstill()
        self._journal_words = ""
        self._closed = False
        self._snapshot = MillSnapshot(name=name)
        self._lock = FolderLock(folder)
        try:
            self._folders = RunFolders(folder)
            self._runs: dict[str, Run] = {}
            self._active: Run | None = None
            self._driven: Run | None = None  # the run the present driver has streamed, while its tail is still reported
            self._find_runs()
        except BaseException:
            self._lock.release()
            raise
        self._publish()

    @property
    def snapshot(self) -> MillSnapshot:
        return self._snapshot

    @property
    def runs(self) -> tuple[RunView, ...]:
        """All runs, newest first."""
        return tuple(run.view for run in reversed(self._runs.values()))

    def run(self, run_id: str) -> RunView:
        return self._run(run_id).view

    @property
    def status(self) -> MillStatus:
        return self._link.status

    @property
    def _driver(self) -> Driver | None:
        return self._link.driver

    def wake(self) -> None:
        """End a waiting `step` (from any thread)."""
        self._link.wake()

    def urge(self, stop: str) -> bool:
        """Write the byte that stops motion to the link at once, from any thread; whether there is one and it left."""
        driver = self._link.driver
        return driver is not None and driver.urge(stop)

    def _extend_permit(self) -> None:
        """The order was begun in time; what it asks of the controller first may take a while."""
        if self._permit is not None:
            self._permit.extend()

    def _require_permit(self) -> None:
        """The last look before something leaves: is the order still for now? OrderRefusedError."""
        if self._permit is not None:
            self._permit.require()

    # ------------------------------------------------------------------ runs

    def _run(self, run_id: str) -> Run:
        run = self._runs.get(run_id)
        if run is None:
            raise NotAllowedError(f"no run '{run_id[:80]}' on this mill")
        return run

    def _live(self) -> Run | None:
        return self._active if self._active is not None and self._active.live else None

    def _recoverable(self) -> list[Run]:
        return [run for run in self._runs.values() if run.state in RECOVERABLE]

    def _rest(self, run: Run) -> None:
        if run is not self._active:
            run.let_go()

    def _run_on_disk(self, run_id: str, record: dict[str, Any]) -> Run:
        return Run(record, lambda: self._open_journal(self._folders.path(run_id)))

    def _find_runs(self) -> None:
        left: Run | None = None
        for run_id, content in self._folders.found():
            run = self._run_on_disk(run_id, dict(content.state))
            self._runs[run_id] = run
            if content.torn:
                run.record["torn"] = content.torn
                self._say("journal", f"run {run_id}: {content.torn}")
            if left_alone(run.record):
                words = f"the agent ended while the run was {run.record['state']}"
                run.write("run", state=RunState.INTERRUPTED.value, words=words, found_s=round(self._wall(), 3),
                          adrift="" if run.record.get("restarted") else OWNER_LOST)  # fmt: skip
                run.journal.sync()
                self._say("run", f"{run.view.name}: interrupted ({words}); nothing goes on by itself")
                left = run
            run.let_go()
            self._active = left or run

    def _forget_old_runs(self) -> None:
        """Finished runs beyond the newest KEPT_RUNS leave the disk; one that could still be recovered never does."""
        old = [run for run in list(self._runs.values())[:-KEPT_RUNS] if run is not self._active]
        for run in old:
            if run.state is RunState.FINISHED or (run.state is RunState.ABORTED and not run.record.get("started_s")):
                run.let_go()
                if self._folders.remove(run.id):
                    del self._runs[run.id]

    # ------------------------------------------------------------------ touching off between programs

    def _to_touch_off(self) -> list[Run]:
        return [run for run in self._runs.values() if run.record.get("touch_off")]

    def _note_touch_off(self) -> None:
        for run in self._to_touch_off():
            run.write("touched off", touch_off="")
            self._rest(run)

    def _needs(self) -> tuple[str, ...]:
        if self._live() is not None:
            return ()
        return tuple(f"re-probe Z: {run.record['touch_off']}" for run in self._to_touch_off()[-1:])

    # ------------------------------------------------------------------ the snapshot

    def _setup_digest(self, status: MillStatus) -> str:
        """Digest of what a start rests on, to tell whether a person has seen the mill as it is."""
        offset = None if status.work_offset_mm is None else [round(one, 3) for one in status.work_offset_mm]
        rests_on = (offset, self._zeroed, self._homed, status.position_trusted, status.epoch, self._needs())
        return hashlib.sha256(repr(rests_on).encode()).hexdigest()[:16]

    def _publish(self) -> None:
        """A new snapshot, if anything in it differs."""
        driver, before = self._driver, self._snapshot
        views = list(self._runs.values())[-SHOWN_RUNS:]
        status = driver.status if driver is not None else NO_MILL
        snapshot = MillSnapshot(
            version=before.version,
            name=self.name,
            status=status if driver is not None else replace(status, detail=self._link.problem),
            progress=driver.progress if driver is not None else before.progress,
            protections=driver.protections if driver is not None else (),
            facts=driver.facts if driver is not None else before.facts,
            settings=getattr(driver, "settings", None) if driver is not None else before.settings,
            run=self._active.view if self._active is not None else None,
            runs=tuple(run.view for run in reversed(views)),
            latched=self._link.latched,
            problem=self._link.problem,
            needs=self._needs(),
            zeroed=self._zeroed,
            homed=self._homed,
            setup=self._setup_digest(status),
            stops=self.orders.stops,
            lease=self.orders.get_lease(),
            events=self._log.after(before.events),
        )
        if snapshot != before:
            fields = {name: getattr(snapshot, name) for name in snapshot.__slots__}
            self._snapshot = MillSnapshot(**fields | {"version": before.version + 1})
