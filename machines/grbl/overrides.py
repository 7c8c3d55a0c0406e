"""Overrides by realtime bytes: one step of each size per report, because the firmware merges equal bytes."""

from __future__ import annotations

from dataclasses import dataclass

from machines.driver import OVERRIDE_PERCENT, CommandDone, Override, Require, allow_always
from machines.errors import MachineError
from machines.grbl.link import GrblLink
from machines.grbl.replies import Status
from phrases.phrase import NO_WORDS, Phrase

# what -> (place in Ov:, back to 100 %, +10, -10, +1, -1)
_STEPS = {
    "feed": (0, 0x90, 0x91, 0x92, 0x93, 0x94),
    "spindle": (2, 0x99, 0x9A, 0x9B, 0x9C, 0x9D),
}
_RAPID = {100: 0x95, 50: 0x96, 25: 0x97}
REPORTS_TO_CHANGE = 6  # reports without any change after which a step is sent again
GIVE_UP_S = 15.0
MOST_STEPS = 20  # from one end to the other, each the time of a round trip


def find_refusal(what: str, percent: int) -> Phrase | None:
    """Say why this override cannot be set; None if it can."""
    if what == "rapid":
        if percent in _RAPID:
            return None
        return Phrase("rapid override {percent} %: only 25, 50 and 100 exist", percent=percent)
    if what not in _STEPS:
        return Phrase("override '{what}'; allowed: feed, rapid and spindle", what=what)
    low, high = OVERRIDE_PERCENT
    if low <= percent <= high:
        return None
    return Phrase("{what} override {percent} %: from {low} to {high}", what=what, percent=percent, low=low, high=high)


def _read_percent(what: str, overrides: tuple[int, int, int]) -> int:
    """Return this override of a report's Ov."""
    return overrides[1] if what == "rapid" else overrides[_STEPS[what][0]]


def _make_step(what: str, now_percent: int, percent: int) -> bytes:
    """Return realtime bytes that bring the override nearer: at most one coarse and one fine step."""
    if now_percent == percent:
        return b""
    if what == "rapid":
        return bytes([_RAPID[percent]])
    _, back, up10, down10, up1, down1 = _STEPS[what]
    if percent == 100:
        return bytes([back])
    away = percent - now_percent
    coarse, fine = divmod(abs(away), 10)
    out = bytearray()
    if coarse:
        out.append(up10 if away > 0 else down10)
    if fine:
        out.append(up1 if away > 0 else down1)
    return bytes(out)


@dataclass(slots=True, eq=False)
class OverrideControl:
    """Brings one override at a time to its value, as reports show it. Goes beside all other commands."""

    link: GrblLink
    _command: Override | None = None
    _require: Require = allow_always  # each step acts by itself, and is looked at by itself
    _step: bytes = b""  # to be written
    _until_s: float = 0.0
    _reports: int = 0  # since the last step

    @property
    def active(self) -> bool:
        return self._command is not None

    def begin(self, command: Override, now_s: float, require: Require) -> None:
        self.end(Phrase("replaced by a newer override"))
        self._command, self._require = command, require
        self._until_s = now_s + GIVE_UP_S + MOST_STEPS * self.link.silence.round_trip_s
        self._reports = REPORTS_TO_CHANGE
        self.link.poll_at_s = now_s

    def end(self, failure: Phrase = NO_WORDS) -> None:
        """Report the end of the override under way, if there is one."""
        command, self._command, self._step = self._command, None, b""
        if command is not None:
            self.link.events.append(CommandDone(command, failure))

    def take_report(self, report: Status, now_s: float) -> None:
        """Compare a report with what is wanted; put the next step on its way."""
        command, view = self._command, self.link.view
        if command is None:
            return
        self._reports += 1
        if report.overrides is None and self._reports < REPORTS_TO_CHANGE:
            return
        percent = _read_percent(command.what, view.overrides)
        step = _make_step(command.what, percent, command.percent)
        if not step and (report.overrides is not None or view.override_reports):
            self.end()
        elif now_s > self._until_s:
            self.end(Phrase("{what} override stays at {percent} %", what=command.what, percent=percent))
        elif self._reports >= 2:
            self._step = step
            # A step is relative: none is made of a report that is older than the last step.
            self._reports = -self.link.reports_under_way

    def queue_step(self) -> None:
        """Queue the waiting step for the next write. End the override if the order may not be carried out any more."""
        if not self._step:
            return
        step, self._step = self._step, b""
        try:
            self._require()
        except MachineError as refusal:
            self.end(refusal.words)
            return
        self.link.urgent += step
