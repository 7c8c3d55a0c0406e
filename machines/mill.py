"""A mill as its owner sees it: one driver, one journal, at most one live run. Single-threaded: everything is `step`.

Nothing here moves the mill by itself. A lost link is opened again with growing patience, and then the only things sent
unasked are questions and a hold or an abort that somebody had asked for while the link was away. Every start and every
recovery needs a person's confirmation.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from machines.driver import (
    Command,
    CommandDone,
    Driver,
    Event,
    FaultCause,
    Faulted,
    MillState,
    MillStatus,
    Notice,
    ProbeZ,
    ProgramDone,
    ReadSettings,
    Restarted,
    SetZero,
    StateChanged,
    Stopped,
    StreamProgress,
    TrustPosition,
)
from machines.errors import JournalError, MachineError, NotAllowedError, ProgramChangedError
from machines.gcode.preflight import Preflight
from machines.gcode.program import ProgramReader
from machines.journal import Journal
from machines.mill_files import FolderLock, RunFolders, left_alone
from machines.mill_run import Run
from machines.mill_view import LogEntry, MillSnapshot
from machines.recovery import Present, RecoveryPlan, Reentry, plan_recovery
from machines.runs import RECOVER_CHECKS, RECOVERABLE, START_CHECKS, Confirmation, RunState, RunView

__all__ = ["LogEntry", "Mill", "MillSnapshot"]

LOOK_S = 0.05
BACK_OFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
ASK_S = 5.0
LOG_ENTRIES = 100
SHOWN_RUNS = 100
NO_MILL = MillStatus()
_STANDS = frozenset({MillState.HELD, MillState.DOOR, MillState.TOOL, MillState.SLEEP})
_MOVES = frozenset({MillState.RUN, MillState.HOLDING, MillState.JOG, MillState.HOMING})
_AWAY = frozenset({MillState.DISCONNECTED, MillState.CONNECTING})
_PRESUMED = ("G54", "G17", "G94")  # what a program that does not say takes for granted, beside `Preflight.assumed`


class Mill:
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
    ) -> None:
        self.name = name
        self._connect = connect
        self._clock = clock
        self._wall = wall_clock
        self._reentry = reentry or Reentry()
        self._open_journal = open_journal
        self._woken = threading.Event()
        self._pause = pause or self._wait
        self._driver: Driver | None = None
        self._tries = 0
        self._try_at_s = float("-inf")
        self._look_at_s = float("-inf")
        self._problem = ""
        self._latched = ""
        self._hold_asked = False
        self._abort_asked = False
        self._recovering = False
        self._retouch = ""  # why Z must be touched off before the next start
        self._parser_state: str | None = None
        self._journal_words = ""
        self._log: deque[LogEntry] = deque(maxlen=LOG_ENTRIES)
        self._logged = 0
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

    # ------------------------------------------------------------------ what is known

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
        return self._driver.status if self._driver is not None else NO_MILL

    def wake(self) -> None:
        """End a waiting `step` (from any thread)."""
        self._woken.set()
        driver = self._driver
        if driver is not None:
            driver.wake()

    # ------------------------------------------------------------------ time passes

    def step(self, timeout_s: float) -> None:
        """Read, decide, write; wait at most `timeout_s`."""
        if self._driver is None:
            self._open_link(timeout_s)
            return
        events = self._driver.poll(timeout_s)
        for event in events:
            self._on(event)
        if events or self._clock() >= self._look_at_s:
            self._look()

    def _open_link(self, timeout_s: float) -> None:
        wait_s = self._try_at_s - self._clock()
        if wait_s > 0.0:
            self._pause(min(wait_s, timeout_s))
            return
        try:
            driver = self._connect()
        except MachineError as error:
            self._no_link(str(error))
            return
        self._driver = driver
        driver.connect()
        if self._latched == "abort":
            driver.abort()
        elif self._latched == "hold":
            driver.hold()
        self._look()

    def _no_link(self, words: str) -> None:
        if words != self._problem:
            self._say("link", words)
        self._problem = words
        self._try_at_s = self._clock() + BACK_OFF_S[min(self._tries, len(BACK_OFF_S) - 1)]
        self._tries += 1
        self._publish()

    def _wait(self, seconds: float) -> None:
        self._woken.wait(seconds)
        self._woken.clear()

    def _drop_link(self, words: str) -> None:
        driver, self._driver = self._driver, None
        self._driven = None
        self._parser_state = None
        if driver is not None:
            driver.close()
        self._no_link(words)

    def _look(self) -> None:
        """Compare run and mill, mark the journal, renew the snapshot."""
        self._look_at_s = self._clock() + LOOK_S
        driver = self._driver
        if driver is None:
            self._publish()
            return
        status, progress, run = driver.status, driver.progress, self._driven
        if status.state not in _AWAY:
            self._tries, self._problem = 0, ""
            self._latched = ""
        if run is not None:
            try:
                self._follow(run, status, progress)
            except JournalError as error:
                self._journal_failed(run, error)
        self._publish()

    def _follow(self, run: Run, status: MillStatus, progress: StreamProgress) -> None:
        state = run.state
        if run.live and state is not RunState.STOPPING:
            self._mirror(run, state, status, progress)
        if run.live or run.state in RECOVERABLE:
            run.follow(progress, status, self._clock(), self._wall(), moving=status.state is MillState.RUN)
            if run.journal.failure:
                raise JournalError(run.journal.failure)

    def _mirror(self, run: Run, state: RunState, status: MillStatus, progress: StreamProgress) -> None:
        """The run's state follows the mill's: a button on the machine holds a run as well as a call does."""
        if self._recovering and progress.answered_line > 0:
            self._recovering = False
        going = RunState.RECOVERING if self._recovering else RunState.RUNNING
        if status.state in _STANDS:
            self._hold_asked = False
            wanted = RunState.HELD
        elif status.state is MillState.HOLDING:
            wanted = RunState.HOLDING
        elif status.state in (MillState.RUN, MillState.IDLE):
            wanted = RunState.HOLDING if self._hold_asked else going
        else:
            return
        if wanted is not state:
            self._change(run, wanted, status.detail if wanted is RunState.HELD else "", status, progress)

    def _change(
        self, run: Run, state: RunState, words: str, status: MillStatus, progress: StreamProgress, **more: Any
    ) -> None:
        """A state change goes to the journal together with how far the run has come."""
        where = {"machine_mm": status.machine_mm, "work_mm": status.work_mm, "wall_s": round(self._wall(), 3)}
        words = words or (self._journal_words if state in (RunState.HOLDING, RunState.HELD) else "")
        self._say("run", f"{run.view.name}: {state.value}{f' ({words})' if words else ''}")
        run.move(state, words, **run.last_mark(progress), **where, **more)

    def _journal_failed(self, run: Run, error: JournalError) -> None:
        """Without a journal nothing may run: hold, and say why. Resume tries the disk again."""
        words = f"held because {error}; make room, then resume"
        if self._journal_words:
            return
        self._journal_words = words
        self._say("journal", words)
        if run.live and run.state is not RunState.STOPPING:
            self._hold_asked = True
            if self._driver is not None:
                self._driver.hold()
            if run.state in (RunState.RUNNING, RunState.RECOVERING):
                run.record.update(state=RunState.HOLDING.value, words=words)

    # ------------------------------------------------------------------ events

    def _on(self, event: Event) -> None:
        run = self._driven
        try:
            if isinstance(event, Faulted):
                self._faulted(event, run)
            elif isinstance(event, ProgramDone) and run is not None and run.live:
                self._ended(run, RunState.FINISHED, "")
                self._retouch = "a program has ended: if the tool is changed now, touch off Z again (probe or set zero)"
            elif isinstance(event, Stopped):
                self._stopped(event)
            elif isinstance(event, Restarted):
                self._restarted(event)
            elif isinstance(event, CommandDone):
                self._commanded(event)
            elif isinstance(event, Notice):
                self._say("notice", event.words)
            elif isinstance(event, StateChanged):
                self._say("state", event.after.value)
        except JournalError as error:
            if run is None:
                self._say("journal", str(error))
            else:
                self._journal_failed(run, error)

    def _faulted(self, event: Faulted, run: Run | None) -> None:
        words = f"{event.cause.value}: {event.words}"
        self._say("fault", words)
        try:
            if run is not None and run.live and self._driver is not None:
                self._hold_asked = self._recovering = False
                self._change(run, RunState.INTERRUPTED, words, self._driver.status, self._driver.progress,
                             cause=event.cause.value, fault_line=event.line)  # fmt: skip
                run.journal.sync()
        finally:
            if self.status.state is MillState.DISCONNECTED:
                if self._abort_asked:
                    self._latched = "abort"
                self._drop_link(event.words)
            elif event.cause is FaultCause.PORT_LOST:
                self._drop_link(event.words)

    def _ended(self, run: Run, state: RunState, words: str) -> None:
        assert self._driver is not None
        self._change(run, state, words, self._driver.status, self._driver.progress, ended_s=round(self._wall(), 3))
        self._hold_asked = self._recovering = False
        if state is RunState.FINISHED:
            self._driven = None
        run.journal.sync()
        run.let_go()

    def _stopped(self, event: Stopped) -> None:
        run = self._active
        kept = "" if event.position_kept else "position lost or never vouched for"
        self._say("state", f"stopped{f': {kept}' if kept else ''}")
        asked, self._abort_asked = self._abort_asked, False
        if run is not None and (run.state is RunState.STOPPING or (asked and run.state is RunState.INTERRUPTED)):
            self._ended(run, RunState.ABORTED, "aborted by the operator")

    def _restarted(self, event: Restarted) -> None:
        """All runs that could be recovered learn that the controller has forgotten its position."""
        self._parser_state = None
        self._say("link", f"controller restarted: {event.banner}")
        if not self.status.position_trusted:
            for run in self._recoverable():
                run.write("restarted", restarted=True)
                self._rest(run)

    def _commanded(self, event: CommandDone) -> None:
        command = event.command
        name = type(command).__name__
        self._say("command", f"{name}: {event.failure or 'done'}", event.answer)
        if event.failure:
            return
        if isinstance(command, ReadSettings):
            self._parser_state = str(event.answer.get("parser_state", "")) or None
        axes = command.axes if isinstance(command, SetZero) else "Z" if isinstance(command, ProbeZ) else ""
        if "Z" in axes:
            self._retouch = ""
        if axes:
            for run in self._recoverable():
                vouched = "".join(sorted({*str(run.record.get("zeroed", "")), *axes}))
                run.write("zeroed", zeroed=vouched)
                self._rest(run)

    def _recoverable(self) -> list[Run]:
        return [run for run in self._runs.values() if run.state in RECOVERABLE]

    def _rest(self, run: Run) -> None:
        if run is not self._active:
            run.let_go()

    # ------------------------------------------------------------------ runs

    def park(self, program: Preflight, path: Path, name: str) -> RunView:
        """A run that waits for its start. Nothing is sent."""
        self._open()
        run_id = self._folders.new_id(self._wall(), program.sha256)
        self._folders.save_facts(run_id, program)
        record = {
            "id": run_id, "name": name, "sha256": program.sha256, "path": str(path.absolute()), "lines": program.lines,
            "bytes": program.bytes, "time_s": program.time_s, "profile": program.profile,
            "created_s": round(self._wall(), 3),
            "warnings": list(program.warnings), "state": RunState.PARKED.value, "executed_line": 0,
        }  # fmt: skip
        run = Run(
            {"id": run_id, "state": RunState.PARKED.value}, lambda: self._open_journal(self._folders.path(run_id))
        )
        run.write("parked", **record)
        run.journal.sync()
        run.facts, run.reader = program, ProgramReader(path, program.index)
        self._runs[run_id] = run
        if self._active is None or not self._active.live:
            if self._active is not None:
                self._active.let_go()
            self._active = run
        self._say("run", f"{name}: parked")
        self._publish()
        return run.view

    def start(self, run_id: str, confirmation: Confirmation) -> None:
        """Stream a parked run from its first line."""
        run = self._run(run_id)
        if run.state is not RunState.PARKED:
            way = "recover it" if run.state in RECOVERABLE else "park the program again"
            raise NotAllowedError(f"start: run {run_id} is {run.state.value}, only a parked run can be started; {way}")
        confirmation.demand(START_CHECKS, "start")
        driver = self._ready_driver("start")
        facts, reader = run.load(self._folders, lambda facts: self._reader(run, facts))
        self._check_file(run, facts)
        answer = self._asked()
        self._check_modes(facts, answer)
        self._vouch(driver)
        baseline = self._baseline(run, confirmation, answer)
        baseline |= {"started_s": round(self._wall(), 3), "executed_line": 0}
        self._go(run, RunState.RUNNING, baseline, lambda: driver.start(reader.lines(1)))

    def plan_recovery(self, run_id: str) -> RecoveryPlan:
        """How the run would go on now: what has to be done first, and what would be sent. Sends only questions."""
        run = self._run(run_id)
        if run.state not in RECOVERABLE:
            raise NotAllowedError(
                f"recovery: run {run_id} is {run.state.value}; only an interrupted or aborted run is recovered"
            )
        if not run.record.get("started_s"):
            raise NotAllowedError(f"recovery: run {run_id} was never started; park the program again")
        facts, reader = run.load(self._folders, lambda facts: self._reader(run, facts))
        answer = self._asked()
        offsets: Any = answer.get("offsets") if answer else None
        present = Present(
            status=self.status,
            offsets=offsets,
            parser_state=self._parser_state,
            restarted=bool(run.record.get("restarted")),
            vouched_axes=str(run.record.get("zeroed", "")),
        )
        plan = plan_recovery(run.record, facts, reader, present, self._reentry)
        self._rest(run)
        return plan

    def recover(self, run_id: str, confirmation: Confirmation) -> None:
        """Go on with an interrupted run, as the plan of this moment says."""
        run = self._run(run_id)
        plan = self.plan_recovery(run_id)
        confirmation.demand(RECOVER_CHECKS, "recover")
        if plan.refusals:
            raise NotAllowedError(f"recover: {'; '.join(plan.refusals)}")
        if plan.needs:
            raise NotAllowedError(f"recover: {'; '.join(need.words for need in plan.needs)}")
        driver = self._ready_driver("recover")
        _, reader = run.load(self._folders, lambda facts: self._reader(run, facts))
        answer = self._asked()
        self._vouch(driver)
        baseline = self._baseline(run, confirmation, answer)
        baseline |= {"recoveries": int(run.record.get("recoveries", 0)) + 1, "ended_s": None}
        self._go(run, RunState.RECOVERING, baseline, lambda: driver.start(plan.lines(reader)))

    def _go(self, run: Run, state: RunState, baseline: dict[str, Any], start: Callable[[], None]) -> None:
        """The last step of start and recover: only when the journal is safe on disk does the first byte leave."""
        if self._active is not None and self._active is not run:
            self._active.let_go()
        before = {name: run.record.get(name) for name in ("state", "words", *baseline)}
        try:
            run.journal.repair()
            run.move(state, "", **baseline)
            run.journal.sync()
            run.begin_stream()
            start()
        except MachineError:
            run.take_back(before)
            self._publish()
            raise
        self._active = self._driven = run
        self._hold_asked = self._abort_asked = False
        self._recovering = state is RunState.RECOVERING
        self._journal_words = self._retouch = ""
        self._say("run", f"{run.view.name}: {run.state.value}, confirmed by {run.record['operator']}")
        self._look()

    def _baseline(self, run: Run, confirmation: Confirmation, answer: dict[str, Any] | None) -> dict[str, Any]:
        """What held at the start, for the day it has to be compared."""
        status = self.status
        known = answer or {}
        return {
            "operator": confirmation.operator, "checks": sorted(confirmation.checks), "offsets": known.get("offsets"),
            "settings": known.get("settings"), "parser_state": known.get("parser_state"), "restarted": False,
            "zeroed": "",
            "controller": status.controller, "epoch": status.epoch, "position_trusted": status.position_trusted,
            "machine_mm": status.machine_mm, "work_mm": status.work_mm, "work_offset_mm": status.work_offset_mm,
            "wall_s": round(self._wall(), 3),
        }  # fmt: skip

    def _vouch(self, driver: Driver) -> None:
        """The operator's word for the zero makes the place where it was given the reference from here on."""
        if not driver.status.position_trusted:
            try:
                driver.command(TrustPosition())
            except NotAllowedError as error:
                self._say("notice", f"the position could not be vouched for: {error}")

    def _ready_driver(self, doing: str) -> Driver:
        self._open()
        if (live := self._live()) is not None:
            raise NotAllowedError(f"{doing}: run {live.id} is {live.state.value}; one run at a time")
        if self._latched:
            raise NotAllowedError(f"{doing}: {self._latched} waits for the link to come back")
        state = self.status.state
        if self._driver is None or state is not MillState.IDLE:
            words = self._problem or self.status.detail
            more = f" ({words})" if words else ""
            raise NotAllowedError(f"{doing}: the mill is {state.value}{more}; allowed when it is idle")
        return self._driver

    def _check_file(self, run: Run, facts: Preflight) -> None:
        path = Path(str(run.record["path"]))
        try:
            size = path.stat().st_size
        except OSError as error:
            raise ProgramChangedError(f"{path}: cannot be read any more ({error.strerror})") from None
        if size != facts.bytes:
            raise ProgramChangedError(f"{path}: has {size} bytes, pre-flight read {facts.bytes}; park it again")

    def _check_modes(self, facts: Preflight, answer: dict[str, Any] | None) -> None:
        """A program that takes modes for granted must find them."""
        modes = str((answer or {}).get("parser_state") or "").split()
        if not modes:
            return
        missing = [mode for mode in (*facts.assumed, *_PRESUMED) if mode not in modes]
        if missing:
            raise NotAllowedError(
                f"start: the program takes {' '.join(missing)} for granted, the controller is in {' '.join(modes)}: "
                f"send '{' '.join(missing)}' first"
            )

    def _reader(self, run: Run, facts: Preflight) -> ProgramReader:
        return ProgramReader(Path(str(run.record["path"])), facts.index)

    def _run(self, run_id: str) -> Run:
        run = self._runs.get(run_id)
        if run is None:
            raise NotAllowedError(f"no run '{run_id[:80]}' on this mill")
        return run

    def _live(self) -> Run | None:
        return self._active if self._active is not None and self._active.live else None

    def _run_on_disk(self, run_id: str, record: dict[str, Any]) -> Run:
        return Run(record, lambda: self._open_journal(self._folders.path(run_id)))

    def _find_runs(self) -> None:
        for run_id, content in self._folders.found():
            run = self._run_on_disk(run_id, dict(content.state))
            self._runs[run_id] = run
            if content.torn:
                run.record["torn"] = content.torn
                self._say("journal", f"run {run_id}: {content.torn}")
            if left_alone(run.record):
                words = f"the agent ended while the run was {run.record['state']}"
                run.write("run", state=RunState.INTERRUPTED.value, words=words, found_s=round(self._wall(), 3))
                run.journal.sync()
                self._say("run", f"{run.view.name}: interrupted ({words}); nothing goes on by itself")
            self._rest(run)
            self._active = run

    # ------------------------------------------------------------------ controls

    def hold(self) -> None:
        """Stop motion, keeping the position. Always taken: without a link it is carried out when the link is back."""
        driver = self._driver
        if driver is not None:
            driver.hold()
        if driver is None or driver.status.state in _AWAY:
            if self._latched != "abort":
                self._latched = "hold"
            self._say("command", "hold: waits for the link")
        run = self._live()
        if run is not None and run.state in (RunState.RUNNING, RunState.RECOVERING):
            self._hold_asked = True
            self._noted(run, RunState.HOLDING, "")
        self._look()

    def resume(self) -> None:
        """Go on after a hold."""
        driver = self._driver
        if self._latched == "hold" and self.status.state in _AWAY:
            raise NotAllowedError("resume: the mill is not connected; the hold is carried out first when it is back")
        if driver is None:
            raise NotAllowedError(f"resume: the mill is disconnected ({self._problem}); allowed when it is held")
        run = self._live()
        if run is not None:
            if run.state not in (RunState.HELD, RunState.HOLDING):
                raise NotAllowedError(f"resume: run {run.id} is {run.state.value}; allowed when it is held")
            run.journal.repair()
            run.journal.append("resume", wall_s=round(self._wall(), 3))
            self._journal_words = ""
        driver.resume()
        self._hold_asked = False
        self._look()

    def abort(self) -> None:
        """End the run: hold, and from standstill clear what the controller holds. Always taken, as `hold` is."""
        run, driver = self._active, self._driver
        if run is not None and run.state is RunState.PARKED and self._live() is None:
            run.move(RunState.ABORTED, "taken back before its start", ended_s=round(self._wall(), 3))
            run.let_go()
            self._look()
            return
        self._abort_asked = True
        if run is not None and run.live and run.state is not RunState.STOPPING:
            self._noted(run, RunState.STOPPING, "")
        if driver is not None:
            driver.abort()
        if driver is None or driver.status.state in _AWAY:
            self._latched = "abort"
            self._say("command", "abort: waits for the link")
        self._look()

    def command(self, command: Command) -> None:
        """Home, unlock, jog, probe, zero, override ...: the answer comes as an entry of the log."""
        self._open()
        if self._driver is None:
            raise NotAllowedError(f"{type(command).__name__}: the mill is disconnected ({self._problem})")
        self._driver.command(command)
        self._look()

    def _noted(self, run: Run, state: RunState, words: str) -> None:
        """A change that was asked for. A disk that refuses does not stop a stop."""
        status = self.status
        progress = self._driver.progress if self._driver is not None and run is self._driven else None
        try:
            self._change(run, state, words, status, progress or StreamProgress(executed_line=run.executed_line))
        except JournalError as error:
            self._say("journal", str(error))

    def _asked(self) -> dict[str, Any] | None:
        """Settings, offsets and parser state, read now; None where the link does not tell or the mill is not idle."""
        driver = self._driver
        if driver is None or driver.status.state not in (MillState.IDLE, MillState.ALARM):
            return None
        wanted = ReadSettings()
        try:
            driver.command(wanted)
        except NotAllowedError:
            return None
        until_s = self._clock() + ASK_S
        answer: dict[str, Any] | None = None
        ended = False
        # The work position comes with the offset, and that only with every tenth report or so.
        while self._clock() < until_s and self._driver is driver and not (ended and driver.status.work_mm is not None):
            for event in driver.poll(0.05):
                self._on(event)
                if isinstance(event, CommandDone) and event.command == wanted:
                    ended = True
                    answer = None if event.failure else dict(event.answer)
            if ended and answer is None:
                break
        return answer

    # ------------------------------------------------------------------ ending

    def may_close(self, *, detach: bool = False) -> None:
        """NotAllowedError while the mill moves under a live run, unless it may go on unwatched."""
        run = self._live()
        if detach or run is None or self.status.state not in _MOVES:
            return
        raise NotAllowedError(f"stop: run {run.id} is {run.state.value}, the mill {self.status.state.value}; hold it, "
                              "or say that it may go on without us (detach)")  # fmt: skip

    def close(self, *, detach: bool = False) -> None:
        """Let go of port, journal and folder. The mill keeps what it holds; a live run will be found interrupted."""
        if self._closed:
            return
        self.may_close(detach=detach)
        self._closed = True
        if self._driver is not None:
            self._driver.close()
            self._driver = None
        for run in self._runs.values():
            run.close()
        self._lock.release()

    def note_failure(self, error: BaseException) -> None:
        """The owner thread ends because of this: hold what moves, and leave the words behind."""
        self._say("fault", f"the agent failed: {type(error).__name__}: {error}")
        if self._driver is not None and self.status.state in _MOVES:
            self._driver.hold()
        self._publish()

    def _open(self) -> None:
        if self._closed:
            raise NotAllowedError(f"mill {self.name} is closed")

    # ------------------------------------------------------------------ the snapshot

    def _say(self, kind: str, words: str, answer: dict[str, object] | None = None) -> None:
        self._logged += 1
        self._log.append(LogEntry(self._logged, round(self._wall(), 3), kind, words, dict(answer or {})))

    def _needs(self) -> Sequence[str]:
        if self._retouch and self._live() is None:
            return (f"re-probe Z: {self._retouch}",)
        return ()

    def _publish(self) -> None:
        """A new snapshot, if anything in it differs."""
        driver, before = self._driver, self._snapshot
        views = list(self._runs.values())[-SHOWN_RUNS:]
        snapshot = MillSnapshot(
            version=before.version,
            name=self.name,
            status=driver.status if driver is not None else MillStatus(detail=self._problem),
            progress=driver.progress if driver is not None else before.progress,
            protections=driver.protections if driver is not None else (),
            facts=driver.facts if driver is not None else before.facts,
            settings=getattr(driver, "settings", None) if driver is not None else before.settings,
            run=self._active.view if self._active is not None else None,
            runs=tuple(run.view for run in reversed(views)),
            latched=self._latched,
            problem=self._problem,
            needs=tuple(self._needs()),
            events=before.events if before.events and before.events[-1].number == self._logged else tuple(self._log),
        )
        if snapshot != before:
            fields = {name: getattr(snapshot, name) for name in snapshot.__slots__}
            self._snapshot = MillSnapshot(**fields | {"version": before.version + 1})
