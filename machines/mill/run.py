"""One run on a mill: its record, its journal, and its progress."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from machines.driver import MillStatus, StreamProgress
from machines.errors import JournalError
from machines.gcode.program import ProgramReader
from machines.journal.journal import Journal
from machines.preflight.preflight import AT_PRESENT_ZERO, Preflight
from machines.preflight.timeline import compute_time_at_s
from machines.runs import LIVE, RunReport, RunState, move_state

MARK_EVERY_S = 0.5
LINK_LOST = "link"  # why a run is unattended: here the journal has the last line sent
OWNER_LOST = "owner"  # here the journal is up to a second behind
_PACE_PRIOR_S = 60.0  # weight of the estimate's pace: the run's own pace then enters without a jump


class Run:
    """State changes go through `move`, which writes them to the record and to the disk."""

    def __init__(
        self, record: dict[str, Any], open_journal: Callable[[], Journal], load_facts: Callable[[], Preflight]
    ) -> None:
        self.record = record
        self._open_journal = open_journal
        self._load_facts = load_facts
        self._journal: Journal | None = None
        self._base_line = 0  # executed before the present stream began
        self._marked_s = float("-inf")
        self._marked: tuple[object, ...] = ()
        self._looked_s: float | None = None
        self._moving_s = 0.0
        self._moved_s = 0.0  # the part until the last executed line, which is known some time after its execution
        self._view: RunReport | None = None
        self.facts: Preflight | None = None
        self.reader: ProgramReader | None = None

    @property
    def id(self) -> str:
        return str(self.record["id"])

    @property
    def name(self) -> str:
        """The program's name, which people know; only the caller that parked the run knows its id."""
        return str(self.record.get("name") or self.path.name)

    @property
    def path(self) -> Path:
        """The program."""
        return Path(str(self.record["path"]))

    @property
    def state(self) -> RunState:
        return RunState(self.record["state"])

    @property
    def live(self) -> bool:
        return self.state in LIVE

    @property
    def cuts(self) -> bool:
        """Whether it cuts: false for a dry pass."""
        return self.record.get("lift_mm") is None

    @property
    def unattended(self) -> str:
        """LINK_LOST or OWNER_LOST while the mill's position still shows how far it went unattended; otherwise ""."""
        return str(self.record.get("adrift") or "")

    @property
    def executed_line(self) -> int:
        return int(self.record.get("executed_line", 0))

    @property
    def view(self) -> RunReport:
        if self._view is None:
            self._view = _make_view(self.record, self._compute_time_at_s(self.executed_line), self._time_left_s())
        return self._view

    def load(self) -> tuple[Preflight, ProgramReader]:
        """Return facts and reader; load them from disk if they are not in memory."""
        if self.facts is None or self.reader is None:
            self.facts = self._load_facts()
            self.reader = ProgramReader(self.path, self.facts.index)
        return self.facts, self.reader

    @property
    def lasting_warnings(self) -> list[str]:
        """The warnings that do not depend on the work zero."""
        return [one for one in self.record.get("warnings", ()) if not one.startswith(AT_PRESENT_ZERO)]

    # ------------------------------------------------------------------ what is written

    def write(self, kind: str, **fields: Any) -> None:
        """Write to the record and to the journal. The record keeps it even if the disk fails."""
        self.record.update(fields)
        self._view = None
        self.journal.append(kind, **fields)

    def move(
        self, state: RunState, words: str = "", *, code: str = "", values: dict[str, Any] | None = None, **fields: Any
    ) -> None:
        """Change the state, as the table of moves allows."""
        after = move_state(self.state, state)
        self.write("run", state=after.value, words=words, code=code, values=values or {}, **fields)

    def begin_stream(self) -> None:
        """Begin counting lines: a driver is about to stream from here."""
        self._base_line = self.executed_line
        self._looked_s = None
        self._moving_s = self._moved_s = 0.0

    def follow(
        self, progress: StreamProgress, status: MillStatus, now_s: float, wall_s: float, *, moving: bool
    ) -> None:
        """Take over the driver's progress; write a mark to the journal at intervals and when it matters."""
        if self._looked_s is not None and moving:
            self._moving_s += now_s - self._looked_s
        self._looked_s = now_s
        executed = max(self._base_line, progress.executed_line)
        if executed != self.executed_line:
            self._moved_s = self._moving_s
        if executed != self.executed_line or progress.sent_line != self.record.get("sent_line"):
            self.record["executed_line"], self.record["sent_line"] = executed, progress.sent_line
            self._view = None
        if now_s < self._marked_s + MARK_EVERY_S:
            return
        fields: dict[str, Any] = {
            "sent_line": progress.sent_line,
            "offset": progress.sent_offset,
            "answered_line": progress.answered_line,
            "executed_line": executed,
            "in_flight_bytes": progress.bytes_in_flight,
            "in_flight_lines": progress.lines_in_flight,
            "work_offset_mm": status.work_offset_mm,
            "mill_state": status.state.value,
            "position_trusted": status.position_trusted,
            "epoch": status.epoch,
            "overrides": status.overrides,
        }
        if self.live:  # afterwards the mill may be anywhere: keep the place where the run ended
            fields |= {"machine_mm": status.machine_mm, "work_mm": status.work_mm}
        content = tuple(fields.values())
        if not moving and content == self._marked:
            return  # a run held over the weekend needs no mark
        self._marked_s, self._marked = now_s, content
        self.write("mark", **fields, wall_s=round(wall_s, 3))

    def last_mark(self, progress: StreamProgress) -> dict[str, Any]:
        """Return the mark that goes with a state change, so that the end of a run is exact.

        A fault can take back what positions had seemed to prove, though not beyond where this stream began.
        """
        return {
            "executed_line": max(self._base_line, progress.executed_line),
            "sent_line": progress.sent_line,
            "answered_line": progress.answered_line,
        }

    @property
    def journal(self) -> Journal:
        if self._journal is None:
            self._journal = self._open_journal()
        return self._journal

    def close(self) -> None:
        if self._journal is not None:
            self._journal.close()
            self._journal = None

    def let_go(self) -> None:
        """Release the open file and the index in memory: a run that has ended needs neither."""
        self.close()
        self.facts = self.reader = None

    # ------------------------------------------------------------------ time

    def _time_left_s(self) -> float | None:
        """Return pre-flight's estimate of the rest, scaled by how the run has kept to it since it was last started."""
        lines, total_s = int(self.record.get("lines", 0)), float(self.record.get("time_s", 0.0))
        if not lines or not total_s or self.state is RunState.FINISHED:
            return None
        base_s, now_s = map(self._compute_time_at_s, (self._base_line, self.executed_line))
        pace = (self._moved_s + _PACE_PRIOR_S) / (now_s - base_s + _PACE_PRIOR_S)
        return max(0.0, total_s - now_s) * pace

    def _compute_time_at_s(self, line: int) -> float:
        """Return when pre-flight expects this line to be executed, from the start."""
        lines, total_s = int(self.record.get("lines", 0)), float(self.record.get("time_s", 0.0))
        return compute_time_at_s(self.record.get("timeline") or (), line, lines=lines, time_s=total_s)

    def take_back(self, fields: dict[str, Any]) -> None:
        """Undo a start that did not take place. If the disk refuses this as well, the next record that it accepts
        contains it.
        """
        with contextlib.suppress(JournalError):
            self.write("run", **fields)


def _make_view(record: Mapping[str, Any], cut_s: float, time_left_s: float | None) -> RunReport:
    """Return the public view of a run's record. Values of a start that was taken back are None in the record."""
    return RunReport(
        id=str(record["id"]),
        name=str(record.get("name", "")),
        program=str(record.get("sha256", "")),
        path=str(record.get("path", "")),
        state=RunState(record["state"]),
        words=str(record.get("words") or ""),
        code=str(record.get("code") or ""),
        values=dict(record.get("values") or {}),
        operator=str(record.get("operator") or ""),
        lines=int(record.get("lines", 0)),
        bytes=int(record.get("bytes", 0)),
        sent_line=int(record.get("sent_line") or 0),
        executed_line=int(record.get("executed_line") or 0),
        time_s=float(record.get("time_s", 0.0)),
        cut_s=round(cut_s, 2),
        time_left_s=time_left_s,
        created_s=float(record.get("created_s", 0.0)),
        started_s=record.get("started_s"),
        ended_s=record.get("ended_s"),
        recoveries=int(record.get("recoveries") or 0),
        warnings=tuple(record.get("warnings", ())),
        lift_mm=record.get("lift_mm"),
        lifted_from=str(record.get("lifted_from") or ""),
        travel_in_doubt=bool(record.get("travel_in_doubt")),
    )
