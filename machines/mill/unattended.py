"""Runs whose mill went on alone: watched until it stands, and then booked up to where it has come.

A run is unattended from the moment its link is lost, or its owner dies, until anything is done to the mill that could
move it or its zero: any command, a restart, another run. Only in between does the place where it stands prove anything.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from machines.driver import Driver, MillState, MillStatus, Triple
from machines.errors import MachineError
from machines.gcode.program import ProgramReader
from machines.mill.link import get_settings
from machines.mill.run import OWNER_LOST, Run
from machines.mill.view import MillContext
from machines.recovery.needs import position_doubt
from machines.recovery.plan_model import Present
from machines.recovery.planner import GRBL_DIALECTS
from machines.recovery.standing import LINES_AFTER_LAST_MARK, count_executed_at_rest, tolerance_at_rest_mm
from phrases.phrase import Phrase

STILL_S = 0.5  # two status reports at the same place


@dataclass(eq=False)
class Standstill:
    """Since when the mill has stood idle at one place."""

    _place: Triple | None = None
    _since_s: float = 0.0

    def observe(self, status: MillStatus, now_s: float) -> Triple | None:
        """Take a report; return the mill's place in machine coordinates once it certainly stands there."""
        place = status.machine_mm if status.state is MillState.IDLE else None
        if place != self._place or now_s < self._since_s:
            self._place, self._since_s = place, now_s
        return place if now_s >= self._since_s + STILL_S else None


@dataclass(eq=False)
class UnattendedRuns:
    """Finds out how far the mill has come without us."""

    context: MillContext
    _standstill: Standstill = field(default_factory=Standstill)

    def watch(self) -> None:
        """Book what the mill has done alone, once it stands; the first standstill after the link is back counts."""
        driver = self.context.link.driver
        if driver is None or self.context.runs.live is not None:
            return
        place_mm = self._standstill.observe(driver.status, self.context.clock())
        if place_mm is None:
            return
        for run in self._list_unattended():
            try:
                self._book_place(run, driver, place_mm)
            except MachineError as error:  # the program is gone, or the disk refuses: what was known stays
                self.context.log.say("journal", Phrase("{run}: {error}", run=run.view.name, error=error.words))
                run.record["adrift"] = ""

    def note_touch(self, but: Run | None = None) -> None:
        """Note that something is done to the mill that may move it or its zero: its place proves nothing more."""
        for run in self._list_unattended():
            if run is not but:
                run.write("ashore", adrift="")
                self.context.runs.let_rest(run)

    def _list_unattended(self) -> list[Run]:
        return [run for run in self.context.runs.recoverable() if run.unattended]

    def _book_place(self, run: Run, driver: Driver, place_mm: Triple) -> None:
        _, reader = run.load()
        line = _proven_line(run, reader, driver, place_mm)
        booked: dict[str, Any] = {}
        if line is not None and line > run.executed_line:
            words = Phrase(
                "{run}: the mill went on to the end of line {line} before it stood still", run=run.view.name, line=line
            )
            self.context.log.say("run", words)
            booked = {"executed_line": line, "stood_mm": place_mm}
        run.write("ashore", adrift="", **booked)
        if booked:
            run.journal.hasten()
        self.context.runs.let_rest(run)


def _proven_line(run: Run, reader: ProgramReader, driver: Driver, place_mm: Triple) -> int | None:
    """Return the last line this run has certainly executed; None where nothing can be said of the position."""
    settings, record = get_settings(driver), run.record
    if settings is None or reader.index.dialect not in GRBL_DIALECTS:
        return None
    present = Present.of_run(record, driver.status, settings.parser_state, settings)
    if position_doubt(record, present):
        return None
    last = int(record.get("sent_line") or 0)
    if run.unattended == OWNER_LOST:
        last += LINES_AFTER_LAST_MARK
    return count_executed_at_rest(reader, record, place_mm, last_line=last, tolerance_mm=tolerance_at_rest_mm(settings))
