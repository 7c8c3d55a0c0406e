"""A mill as its owner drives it: one driver, one journal, at most one live run. Single-threaded: `step` does
everything.

Nothing here moves the mill by itself. A lost link is opened again at growing intervals. After that the only bytes sent
automatically are queries, and a hold or an abort that was ordered while the link was away. Every start and every
recovery needs a person's confirmation.

A spindle that a person has switched on by hand is switched off when that person's control ends.

The parts: `link` and `run_store` hold the link and the runs; `run_control` the streamed run, and runs whose mill went
on unattended; `commands` sends commands outside a run, `travelling` plans ways, `hand_spindle` switches the spindle
outside a run; `cycle` reads the driver; `starting` starts and recovers; `view` has the shared context, log and
snapshot. `Mill` combines them and carries out orders.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from machines.clock import make_running_clock
from machines.driver import Command, Driver, JogCancel, MillState, MillStatus
from machines.errors import MachineError, MillCode, NotAllowedError
from machines.journal.journal import Journal
from machines.mill.commands import Commands
from machines.mill.cycle import MillCycle
from machines.mill.hand_spindle import HandSpindle
from machines.mill.link import MillLink
from machines.mill.orders import Caller, Order, OrderGate, Stop
from machines.mill.run_control import RunControl, UnattendedRuns
from machines.mill.run_store import RunStore
from machines.mill.starting import RecoveryPlanner, RunStarter
from machines.mill.travelling import WayPlanner
from machines.mill.view import MillContext, MillLog, MillSnapshot, SnapshotPublisher
from machines.preflight.preflight import Preflight
from machines.recovery.plan_model import RecoveryPlan, Reentry
from machines.runs import Confirmation, RunReport
from phrases.phrase import Phrase

T = TypeVar("T")

_SPINDLE_S = 2.0  # for M5 and its answer
_MOVES = frozenset({MillState.RUN, MillState.HOLDING, MillState.JOG, MillState.HOMING})


class Mill:
    """One mill and the folder its runs live in."""

    def __init__(
        self,
        *,
        name: str,
        connect: Callable[[], Driver],
        folder: Path,
        clock: Callable[[], float] | None = None,
        wall_clock: Callable[[], float] = time.time,
        reentry: Reentry,
        open_journal: Callable[[Path], Journal] = Journal,
        pause: Callable[[float], object] | None = None,
        orders: OrderGate | None = None,
        spindle_rpm: tuple[float, float] | None = None,
    ) -> None:
        clock = clock or make_running_clock()
        self.name = name
        self._clock = clock
        self.orders = orders or OrderGate(wall_clock=wall_clock)
        self._order = Order()
        self._closed = False
        self._log = MillLog(wall_clock)
        self._link = MillLink(connect, clock, pause, self._log.say)
        self._runs = RunStore(folder, wall_clock, open_journal, self._log.say)
        context = MillContext(
            link=self._link, runs=self._runs, log=self._log, orders=self.orders, clock=clock, wall_clock=wall_clock
        )
        self._publisher = SnapshotPublisher(name, context)
        unattended = UnattendedRuns(context)
        self._control = RunControl(context)
        self._commands = Commands(context, unattended)
        self._spindle = HandSpindle(context, self._commands, spindle_rpm)
        self._cycle = MillCycle(context, self._control, self._commands, self._spindle, unattended, self.publish)
        self._planner = RecoveryPlanner(context, self._cycle, reentry)
        self._ways = WayPlanner(context, reentry.safe_z_mm)
        self._starter = RunStarter(context, self._cycle, self._control, unattended, self._planner, self._spindle)
        self.publish()

    @property
    def snapshot(self) -> MillSnapshot:
        return self._publisher.snapshot

    @property
    def runs(self) -> tuple[RunReport, ...]:
        """All runs, newest first."""
        return self._runs.views()

    def run(self, run_id: str) -> RunReport:
        return self._runs.get(run_id).view

    @property
    def status(self) -> MillStatus:
        return self._link.status

    def publish(self) -> None:
        """Update the snapshot."""
        self._publisher.publish()

    def step(self, timeout_s: float) -> None:
        """Read, decide, write; wait at most `timeout_s`."""
        self._cycle.step(timeout_s)

    def wake(self) -> None:
        """End a waiting `step` (from any thread)."""
        self._link.wake()

    def urge(self, stop: str) -> bool:
        """Write the byte that stops motion to the link at once, from any thread; return whether it was sent."""
        driver = self._link.driver
        return driver is not None and driver.urge(stop)

    # ------------------------------------------------------------------ orders

    def carry_out(self, doing: str, act: Callable[[Mill], T], caller: Caller, *, needs_lease: bool = False) -> T:
        """Carry out an order under the caller's grant; log the caller and the result.

        The grant is checked now, and again just before the write. OrderRefusedError, or the error of `act`.
        """
        try:
            self._order = Order(caller, self.orders.redeem(caller.grant, doing, needs_lease=needs_lease))
            answer = act(self)
        except MachineError as error:
            values = {"order": doing, "words": str(error), "code": error.code, "values": error.values}
            refused = MillCode.ORDER_REFUSED
            self._log.say("order", f"{doing}: refused: {error}", caller=caller, code=refused, values=values)
            self.publish()
            raise
        finally:
            self._order = Order()
        self._log.say("order", f"{doing}: taken", caller=caller, code=MillCode.ORDER_TAKEN, values={"order": doing})
        self.publish()
        return answer

    def park(
        self, program: Preflight, path: Path, name: str, *, lift_mm: float | None = None, lifted_from: str = ""
    ) -> RunReport:
        """Add a run that waits for its start. Nothing is sent. lift_mm, lifted_from : as in `RunReport`"""
        self._require_open()
        run = self._runs.park(program, path, name, lift_mm=lift_mm, lifted_from=lifted_from)
        self.publish()
        return run.view

    def start(self, run_id: str, confirmation: Confirmation, *, setup: str | None = None) -> None:
        """Stream a parked run from its first line.

        setup : `MillSnapshot.setup` as the person saw it; OrderRefusedError if it has changed since
        """
        self._begin(lambda: self._starter.start(run_id, confirmation, self._order, setup=setup))

    def plan_recovery(self, run_id: str) -> RecoveryPlan:
        """Plan the recovery of the run as of now: needs first, and the lines that would be sent. Sends only queries."""
        run = self._runs.get(run_id)
        plan, _, _ = self._planner.plan(run)
        self._runs.let_rest(run)
        return plan

    def recover(self, run_id: str, confirmation: Confirmation, *, plan_seen: str | None = None) -> None:
        """Continue an interrupted run by its present plan.

        plan_seen : digest of the plan that the person has read; OrderRefusedError if the plan has changed since
        """
        self._begin(lambda: self._starter.recover(run_id, confirmation, self._order, plan_seen=plan_seen))

    def _begin(self, act: Callable[[], None]) -> None:
        self._require_open()
        try:
            act()
        except MachineError:
            self.publish()
            raise
        self._cycle.look()

    def resume(self) -> None:
        """Go on after a hold."""
        self._control.resume(self._order)
        self._cycle.look()

    def command(self, command: Command) -> None:
        """Send a command (home, unlock, jog, probe, zero, override ...); its result appears as an entry of the log."""
        self._require_open()
        self._spindle.send(command, self._order)
        self._cycle.look()

    def switch_spindle(self, rpm: float | None) -> None:
        """Switch the spindle on outside programs, within the mill's speeds, or off (None)."""
        self._require_open()
        self._spindle.switch(rpm, self._order)
        self._cycle.look()

    def go_to_zero(self, axes: str, feed_mm_per_min: float) -> None:
        """Go to the work zero at a safe height, and with axes = "XYZ" down to it. The result is an entry of the log."""
        way = self._ways.to_zero(axes, feed_mm_per_min)
        if axes == "XYZ":
            self._spindle.require_off(way.name)
        self.command(way)

    def frame(self, program: str, feed_mm_per_min: float, *, confirmed: bool = False) -> None:
        """Go around the outline of the waiting program, above all its moves. As `WayPlanner.around`."""
        self.command(self._ways.around(program, feed_mm_per_min, confirmed=confirmed))

    # ------------------------------------------------------------------ stops

    def carry_out_stop(self, stop: Stop, caller: Caller) -> None:
        """Hold, abort or end a jog for any caller; the log names the caller."""
        self._log.say("order", stop.value, caller=caller, code=stop.value)
        {Stop.HOLD: self.hold, Stop.ABORT: self.abort, Stop.JOG_CANCEL: self.cancel_jog}[stop]()

    def hold(self) -> None:
        """Stop motion, keeping the position. Always accepted; without a link, done when it is back."""
        try:
            self._control.hold()
        finally:
            self._cycle.look()

    def abort(self) -> None:
        """End the run: hold, and from standstill clear the controller's buffers. Always accepted, like `hold`."""
        try:
            self._control.abort()
        finally:
            self._cycle.look()

    def cancel_jog(self) -> None:
        """End a jog, keeping the position. Nothing to do without a link."""
        if self._link.driver is not None and not self._link.away:
            self.command(JogCancel())

    # ------------------------------------------------------------------ ending

    def require_closable(self, *, detach: bool = False) -> None:
        """Raise NotAllowedError while the mill moves under a live run, unless it may go on unwatched."""
        run = self._runs.live
        if detach or run is None or self.status.state not in _MOVES:
            return
        raise NotAllowedError(
            Phrase(
                "stop: {run} is {run_state}, the mill {state}; hold it, or let it go on without this program (detach)",
                run=run.name,
                run_state=run.state.words,
                state=self.status.state.words,
            )
        )

    def close(self, *, detach: bool = False) -> None:
        """Release port, journal and folder. The mill keeps its buffer; a live run will be found interrupted."""
        if self._closed:
            return
        self.require_closable(detach=detach)
        self._closed = True
        try:
            self._switch_spindle_off()
        finally:
            try:
                self._link.close()
            finally:
                self._runs.close()

    def _switch_spindle_off(self) -> None:
        """Wait a moment until the controller has switched off a spindle that a person has switched on."""
        self._spindle.end()
        until_s = self._clock() + _SPINDLE_S
        while self._spindle.may_turn and self._link.driver is not None and self._clock() < until_s:
            self._cycle.step(0.05)
            self._cycle.look()

    def note_failure(self, error: BaseException) -> None:
        """Hold a mill that moves or may move, because this failure ends the owner thread; log the reason."""
        reason = f"{type(error).__name__}: {error}"
        self._log.say("fault", f"the agent failed: {reason}", code=MillCode.OWNER_FAILED, values={"reason": reason})
        if self._link.driver is not None and (self._runs.live is not None or self.status.state in _MOVES):
            self._link.hold_unasked()
        self.publish()

    def _require_open(self) -> None:
        if self._closed:
            raise NotAllowedError(Phrase("mill {mill} is closed", mill=self.name))
