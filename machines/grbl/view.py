"""The state of the machine from its reports: positions in mm, overrides, and whether the position can be trusted."""

from __future__ import annotations

from machines.driver import Triple
from machines.grbl.replies import POSITION_LOST_ALARMS, SPINDLE_ON_ALARMS, Status
from machines.grbl.settings import MM_PER_INCH, ControllerSettings, list_frame_changes
from machines.grbl.states import stands

_AXES = frozenset("XYZ")
_REPORTS_TO_ALL = 40  # by then GRBL has reported every field twice; a firmware that leaves one out never does


def has_kept_count(before_mm: Triple | None, now_mm: Triple | None, tolerance_mm: float) -> bool:
    """Return whether a mill that stood at `before_mm` and stands at `now_mm` has certainly kept its count.

    It has if both positions are the same and not 0,0,0, from which a controller counts after a power loss.
    """
    if before_mm is None or now_mm is None:
        return False
    same = all(abs(a - b) <= tolerance_mm for a, b in zip(before_mm, now_mm, strict=True))
    return same and any(abs(a) > tolerance_mm for a in now_mm)


class MachineView:
    """Updated by reports; a new epoch clears the state that does not survive a restart."""

    def __init__(self) -> None:
        self.settings = ControllerSettings()
        self.identified = False
        self.report: Status | None = None
        self.reports = 0
        self.alarm = 0  # number of the present alarm, 0 for none
        self.locked_by = 0  # the same, but kept after the banner, as long as the controller stays locked
        self.work_offset: Triple | None = None  # report units
        self.modes = ""  # words of [GC:], or the modes that the last program has left
        self.overrides = (100, 100, 100)
        self.override_reports = 0  # reports with Ov so far
        self.spindle_on: bool | None = None
        self.spindle_stopped = False  # by an alarm; no report has shown it since
        self.rx_empty: int | None = None  # most free bytes that Bf: has reported: the buffer was empty then
        self._vouched: set[str] = set()
        self._stood_mm: Triple | None = None  # where the mill stood before the last banner
        self._kept_by_reset = False  # that banner answers a reset of ours

    @property
    def trusted(self) -> bool:
        return self._vouched >= _AXES

    def vouch(self, axes: str) -> None:
        self._vouched |= set(axes) & _AXES

    def lose_position(self) -> None:
        self._vouched.clear()

    def begin_epoch(self, *, position_kept: bool) -> None:
        """Clear the state that a banner ends. position_kept: it answers our own reset of a mill at standstill."""
        report = self.report
        sure = report is not None and stands(report) and report.state != "Sleep"
        self._stood_mm = self.machine_mm if sure and self.alarm not in POSITION_LOST_ALARMS else None
        self._kept_by_reset = position_kept
        self.report = None
        self.alarm = 0
        self.work_offset = None
        self.overrides = (100, 100, 100)
        self.spindle_on = False
        self.spindle_stopped = False
        if not position_kept and self._stood_mm is None:
            self.lose_position()

    def judge_place(self) -> bool:
        """Judge with the first report after a banner whether machine coordinates are unchanged.

        The same place as before, not zero, proves it: a controller that lost its power counts from 0,0,0. Another place
        disproves it, even after our own reset.
        """
        before, now = self._stood_mm, self.machine_mm
        tolerance_mm = max(self.settings.step_mm or (0.01,)) + self.report_step_mm
        kept = self._kept_by_reset
        if before is not None and now is not None:
            stays = all(abs(a - b) <= tolerance_mm for a, b in zip(before, now, strict=True))
            kept = (kept and stays) or has_kept_count(before, now, tolerance_mm)
        self._stood_mm = None
        if not kept:
            self.lose_position()
        return kept

    def take_settings(self, settings: ControllerSettings) -> tuple[str, ...]:
        """Store settings that were read again. Return those that define the frame and have changed; if there are any,
        the position is no longer trusted.
        """
        changes = list_frame_changes(self.settings.values, settings.values)
        if changes:
            self.lose_position()
        self.settings = settings
        self.modes = settings.parser_state or self.modes
        return changes

    @property
    def waits_for_fields(self) -> bool:
        """Whether fields are missing that come only with about every tenth report."""
        return self.work_offset is None or (self.spindle_on is None and self.reports < _REPORTS_TO_ALL)

    def take_alarm(self, number: int) -> None:
        self.alarm = self.locked_by = number
        if number in POSITION_LOST_ALARMS:
            self.lose_position()
        if number not in SPINDLE_ON_ALARMS:
            self.spindle_on, self.spindle_stopped = False, True

    def take(self, report: Status) -> bool:
        """Take a report; return whether its position differs from that of the one before."""
        before = self.report
        moved = before is None or (before.machine, before.work) != (report.machine, report.work)
        self.report = report
        self.spindle_stopped = False
        self.reports += 1
        if report.state != "Alarm":
            self.alarm = self.locked_by = 0
        if report.work_offset is not None:
            x, y, z = report.work_offset[:3]
            self.work_offset = (x, y, z)
        if report.overrides is not None:
            self.overrides = report.overrides
            self.override_reports += 1
        if report.buffer is not None:
            self.rx_empty = max(self.rx_empty or 0, report.buffer[1])
        if report.accessories is not None:
            self.spindle_on = "S" in report.accessories or "C" in report.accessories
        return moved

    @property
    def rx_used(self) -> int | None:
        """Bytes of lines in the controller's receive buffer, by the latest report; None if it has no Bf:."""
        report = self.report
        if report is None or report.buffer is None or self.rx_empty is None:
            return None
        return self.rx_empty - report.buffer[1]

    def _unit_mm(self) -> float | None:
        return self.settings.unit_mm if self.identified else None

    def _scale(self, numbers: tuple[float, ...]) -> Triple | None:
        unit_mm = self._unit_mm()
        return None if unit_mm is None else (numbers[0] * unit_mm, numbers[1] * unit_mm, numbers[2] * unit_mm)

    @property
    def machine_mm(self) -> Triple | None:
        report = self.report
        if report is None:
            return None
        if report.machine is not None:
            return self._scale(report.machine)
        if report.work is None or self.work_offset is None:
            return None
        return self._scale(tuple(w + o for w, o in zip(report.work, self.work_offset, strict=False)))

    @property
    def work_mm(self) -> Triple | None:
        """WPos = MPos - WCO; None until the offset has been reported."""
        report = self.report
        if report is None:
            return None
        if report.work is not None:
            return self._scale(report.work)
        if report.machine is None or self.work_offset is None:
            return None
        return self._scale(tuple(m - o for m, o in zip(report.machine, self.work_offset, strict=False)))

    @property
    def work_offset_mm(self) -> Triple | None:
        return None if self.work_offset is None else self._scale(self.work_offset)

    @property
    def feed_mm_per_min(self) -> float | None:
        unit_mm = self._unit_mm()
        if self.report is None or self.report.feed is None or unit_mm is None:
            return None
        return self.report.feed * unit_mm

    @property
    def report_step_mm(self) -> float:
        """Last digit of a reported position: 3 decimals in mm, 4 in inch."""
        return 0.0001 * MM_PER_INCH if self.settings.reports_in_inch else 0.001

    @property
    def exact_mm(self) -> float:
        """How far the reported position of a standing mill may be from its true one: a step and the last digit."""
        steps = self.settings.step_mm or (0.01, 0.01, 0.01)
        return 1.7321 * self.report_step_mm + 0.5 * sum(step * step for step in steps) ** 0.5
