"""How long a healthy mill may be silent. Law: on a healthy link no program is ever stopped by these rules.

Three signs, from quick to slow, each enough by itself:
- no answer to '?' for REPORT_SILENCE_S of our own time: the controller or the link is dead, in every state;
- Idle with lines unanswered for IDLE_S: nothing moves, so an answer could only wait for a dwell or a spindle: a line or
  a reply was lost, or the stepper ran dry;
- no answer, no new position and no step proven for longer than everything still under way can take at worst.

Time is SilenceClock's: only time counts in which we, and for the last two signs the link, could have heard. The round
trip measured on this link is added to every limit on an answer (`late_s`). Nothing is lost by waiting: a mill that gets
no lines runs dry and waits. The clock of the last two starts anew with every answer, every change of a reported
position and every hold, so that the worst case need not be close: it is there for motion that looks like standing (a
circle in one poll).
"""

from __future__ import annotations

from collections.abc import Iterable
from math import sqrt

from machines.clock import RunningTime
from machines.gcode.modal import Step
from machines.grbl.settings import ControllerSettings

MARGIN_S = 2.0  # scheduling, USB adapters, networks
SLACK = 1.5  # jerk-limited motion (grblHAL) takes up to half as long again; ceramic resonators are 0.5 % off
REPORT_SILENCE_S = 30.0  # until a link counts as lost: replies wait in drivers, networks and starved processes
HANDSHAKE_SILENCE_S = 3.0
IDLE_S, IDLE_REPORTS = 2.0, 5  # Idle must last this long, in this many reports in a row
BANNER_S = 5.0  # reset to banner: 0.1 s on an Uno, 2 s on an ESP32 that brings up its network
HOLD_S = 8.0  # hold to standstill: rate / acceleration, 5000 mm/min at 20 mm/s2 is 4 s
SPINDLE_S = 30.0  # grblHAL ($394, $395) and FluidNC wait for the spindle; a frequency converter takes its time
DWELL_SLACK = 1.1  # the dwell loop of 1.1 is stretched by its interrupts
UNKNOWN_MM = 2000.0  # a move from or to a place the program does not give, where the travel is not known either
SLOWEST_MM_PER_MIN = 1.0  # no firmware moves slower
OFFER_S = 1.0  # after this time without an answer a person may send a reset
NOTIFY_SILENCE_S = 3.0  # of silence while a program runs, until the operator is notified
PERSON_S = 10.0  # until a controller that a person has sent resets to is given up
REPORT_S = 0.25  # a report is due ten times a second
TRIPS = 2.0  # round trips that a limit on an answer allows: the measured one, and as much again for a slower one
MOST_LATE_S = 10.0  # no usable link takes longer
SLOW_LINK_S = 0.25  # a longer round trip is reported to the person


class SilenceClock(RunningTime):
    """Time that counts during a wait. spent_s: our own; heard_s: the link's. Both only increase.

    A wall clock runs while our process waits for a processor, while the computer sleeps, and while replies wait in a
    driver or a network. None of that is silence of the mill. So our own time passes in looks (`machines.clock`), and
    the link's in reports: between two of them as much of our time as passed, REPORT_S at most. Answers and reports come
    in the order in which they were made; a report that is here shows that no earlier answer is still on its way.

    round_trip_s: travel time of a question and its answer. A longer one counts at once, a shorter one for three
    quarters. A silence between two reports counts, too: it shows that the delay has grown.
    """

    __slots__ = ("_begun_s", "_reported_s", "heard_s", "notified", "round_trip_s", "unanswered")

    def __init__(self) -> None:
        super().__init__()
        self.heard_s = self.round_trip_s = 0.0
        self.unanswered = 0  # '?' written since the last report
        self.notified = False  # the operator knows of this silence
        self._begun_s = self._reported_s = 0.0

    def take_report(self) -> None:
        """End the silence: a report has come."""
        silent_s = self.silent_s
        self.round_trip_s = max(self.round_trip_s, min(silent_s - REPORT_S, MOST_LATE_S))
        self.heard_s += min(silent_s, REPORT_S)
        self._reported_s = self.spent_s
        self.unanswered = 0
        self.notified = False

    def note_answer(self, waited_s: float) -> None:
        """Take the time between a question that is answered at once and its answer as a round trip."""
        trip_s = min(waited_s, MOST_LATE_S)
        self.round_trip_s = max(trip_s, (self.round_trip_s + 3.0 * trip_s) / 4.0)

    def begin_wait(self) -> None:
        """Begin to wait for reports: a phase begins."""
        self._begun_s = self._reported_s = self.spent_s
        self.notified = False

    @property
    def late_s(self) -> float:
        """Return the time that a limit on an answer adds for the link."""
        return TRIPS * self.round_trip_s

    @property
    def waited_s(self) -> float:
        """Our time since the phase began."""
        return self.spent_s - self._begun_s

    @property
    def silent_s(self) -> float:
        """Our time without a report."""
        return self.spent_s - self._reported_s


def motion_time_s(step: Step, settings: ControllerSettings, overrides: tuple[int, int, int]) -> float:
    """Return the longest time for one move: every block of it from rest to rest, at the rate and acceleration of the
    weakest axis.

    L / v + v / a where the block reaches its speed, else 2 sqrt(L / a); 0 for a block that does not move.
    """
    if not step.moves:
        return 0.0
    rates = settings.max_rate_mm_per_min
    slowest = min(rates) if rates and min(rates) > 0.0 else 500.0
    if step.kind == "rapid" or not step.feed_mm_per_min:
        rate = slowest * overrides[1] / 100.0
    else:
        rate = min(step.feed_mm_per_min * overrides[0] / 100.0, slowest)
    accelerations = settings.acceleration_mm_per_s2
    acceleration = min(accelerations) if accelerations and min(accelerations) > 0.0 else 10.0
    speed = max(rate, SLOWEST_MM_PER_MIN) / 60.0
    length_mm = _length_mm(step, settings)
    blocks = _chords(step, length_mm, settings.arc_tolerance_mm)
    each_mm = length_mm / blocks
    if each_mm >= speed * speed / acceleration:
        return blocks * (each_mm / speed + speed / acceleration)
    return blocks * 2.0 * sqrt(each_mm / acceleration)


def _length_mm(step: Step, settings: ControllerSettings) -> float:
    if None not in step.start_mm and None not in step.end_mm:
        return step.length_mm
    travel = settings.travel_mm
    return step.length_mm + (sum(travel) if travel else UNKNOWN_MM)


def _chords(step: Step, length_mm: float, tolerance_mm: float | None) -> int:
    """Return how many blocks the firmware makes of a move ($12): one, or the chords of an arc.

    A chord with the sagitta e on the radius r is 2 sqrt(e (2 r - e)) long, at least 2 e: with r unknown, the shortest.
    """
    if step.kind != "arc":
        return 1
    error_mm = max(tolerance_mm or 0.002, 0.0005)
    radius_mm = step.arc.radius_mm if step.arc is not None else error_mm
    inner = error_mm * (2.0 * radius_mm - error_mm)
    return 1 + int(length_mm / (2.0 * sqrt(inner))) if inner > 0.0 else 1


def longest_wait_s(
    first: Step | None,
    queued: Iterable[Step],
    settings: ControllerSettings,
    overrides: tuple[int, int, int],
    *,
    standing: bool = False,
) -> float | None:
    """Return the longest time without any sign until the answer to `first` is due; None if it waits for a person.

    first    : the oldest unanswered line; None: all are answered, and the mill has not come to rest yet
    queued   : moves that were answered and may not be executed yet
    standing : the mill has reported Idle for IDLE_S: no motion is left
    """
    if first is not None and first.withholds_ok:
        return None
    motion_s = 0.0
    if not standing:
        motion_s = sum(motion_time_s(step, settings, overrides) for step in queued)
        motion_s += motion_time_s(first, settings, overrides) if first is not None else 0.0
    return MARGIN_S + SLACK * motion_s + (_pause_s(first, settings) if first is not None else 0.0)


def _pause_s(step: Step, settings: ControllerSettings) -> float:
    """Return how long the mill stands still on purpose: a dwell, or a spindle that speeds up or runs down."""
    if step.pause_s:
        return DWELL_SLACK * step.pause_s
    if not step.waits_for_empty_buffer or step.ends_program:
        return 0.0
    return max(SPINDLE_S, 2.0 * (settings.number(394) or 0.0), 2.0 * (settings.number(395) or 0.0))


def longest_homing_s(settings: ControllerSettings) -> float:
    """Return the longest time $H may take: each axis searches 1.5 times its travel at $25, then at $24 over the
    pull-off $27.

    Without these settings: five minutes.
    """
    travel, seek, feed = settings.travel_mm, settings.number(25), settings.number(24)
    pull_mm = settings.number(27) or 1.0
    if travel is None or not seek or not feed:
        return 300.0
    search_s = sum(1.5 * length / seek * 60.0 for length in travel)
    locate_s = 3 * 2 * (10.0 * pull_mm / feed * 60.0)
    return 15.0 + SLACK * (search_s + locate_s)
