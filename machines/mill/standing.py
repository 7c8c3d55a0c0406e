"""Runs whose mill went on alone: watched until it stands, and then booked up to where it has come.

A run is adrift from the moment its link is lost, or its owner dies, until anything is done to the mill that could
move it or its zero: any command, a restart, another run. Only in between does the place where it stands prove anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from machines.driver import Driver, MillState, MillStatus, Triple
from machines.gcode.program import ProgramReader
from machines.grbl.settings import ControllerSettings
from machines.mill.run import Run
from machines.recovery.needs import position_doubt
from machines.recovery.plan import Present
from machines.recovery.planning import GRBL_DIALECTS
from machines.recovery.standing import LINES_AFTER_LAST_MARK, count_executed_at_rest, tolerance_at_rest_mm

STILL_S = 0.5  # two status reports at the same place

LINK_LOST = "link"  # the journal knows the last line sent
OWNER_LOST = "owner"  # it is up to a second behind


class Standstill:
    """Since when the mill has stood idle at one place."""

    def __init__(self) -> None:
        self._place: Triple | None = None
        self._since_s = 0.0

    def reached(self, status: MillStatus, now_s: float) -> Triple | None:
        """The place in machine coordinates once it is certain that the mill stands there."""
        place = status.machine_mm if status.state is MillState.IDLE else None
        if place != self._place or now_s < self._since_s:
            self._place, self._since_s = place, now_s
        return place if now_s >= self._since_s + STILL_S else None


def proven_line(run: Run, reader: ProgramReader, driver: Driver, place_mm: Triple) -> int | None:
    """The last line this run has certainly executed; None where nothing can be said of the position."""
    settings: ControllerSettings | None = getattr(driver, "settings", None)
    record = run.record
    if settings is None or reader.index.dialect not in GRBL_DIALECTS:
        return None
    present = Present(status=driver.status, parser_state=settings.parser_state, restarted=bool(record.get("restarted")))
    if position_doubt(record, present):
        return None
    last = int(record.get("sent_line") or 0)
    if record.get("adrift") == OWNER_LOST:
        last += LINES_AFTER_LAST_MARK
    return count_executed_at_rest(reader, record, place_mm, last_line=last, tolerance_mm=tolerance_at_rest_mm(settings))


def adrift(runs: Sequence[Run]) -> list[Run]:
    return [run for run in runs if run.record.get("adrift")]


def ashore(run: Run, **fields: Any) -> None:
    """From here on the place of the mill proves nothing more for this run."""
    if run.record.get("adrift") or fields:
        run.write("ashore", adrift="", **fields)
