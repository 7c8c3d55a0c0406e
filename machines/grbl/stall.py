"""How long silence is legal: from the line that waits for its answer and the motion that is before it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from machines.grbl.settings import ControllerSettings
from machines.grbl.tracking import Move

MARGIN_S = 2.0  # scheduling, USB adapters, spindle spin-up waits of grblHAL ($394) are seconds at most
SLACK = 1.5  # acceleration and corners make motion slower than its feed
REPORT_SILENCE_S = 2.0  # ten polls without a report while reports are due
BANNER_S = 5.0  # reset to banner: 0.1 s on an Uno, 2 s on an ESP32 that brings up its network
HOLD_S = 8.0  # hold to standstill: rate / acceleration, 5000 mm/min at 20 mm/s2 is 4 s
SPIN_UP_S = 6.0


class Waiting(Move, Protocol):
    """What is used of the step whose answer is awaited."""

    pause_s: float
    withholds_ok: bool


def motion_time_s(step: Move, settings: ControllerSettings, overrides: tuple[int, int, int]) -> float:
    """Time for one move at its feed, with overrides, and one full start and stop; 0 for what does not move."""
    if not step.moves:
        return 0.0
    rates = settings.max_rate_mm_per_min
    slowest = min(rates) if rates and min(rates) > 0.0 else 500.0
    if step.kind == "rapid" or not step.feed_mm_per_min:
        feed = slowest * overrides[1] / 100.0
    else:
        feed = min(step.feed_mm_per_min * overrides[0] / 100.0, slowest)
    accelerations = settings.acceleration_mm_per_s2
    slow = min(accelerations) if accelerations and min(accelerations) > 0.0 else 10.0
    speed = max(feed, 1.0) / 60.0
    # A short move never reaches its feed: from rest to rest takes 2 sqrt(length / a).
    ramp_s = min(speed / slow, 2.0 * (step.length_mm / slow) ** 0.5)
    return step.length_mm / speed + ramp_s


def longest_wait_s(
    first: Waiting,
    queued: Iterable[Move],
    settings: ControllerSettings,
    overrides: tuple[int, int, int],
) -> float | None:
    """Longest time after the last answer in which the answer to `first` is due; None if it waits for a person.

    queued : moves that were answered and may not be executed yet
    """
    if first.withholds_ok:
        return None
    times = [motion_time_s(step, settings, overrides) for step in queued]
    own_s = motion_time_s(first, settings, overrides)
    wait_s = sum(times) if first.waits_for_empty_buffer else max(times, default=0.0)
    spin_s = SPIN_UP_S if first.waits_for_empty_buffer else 0.0
    return MARGIN_S + SLACK * (wait_s + own_s) + first.pause_s + spin_s


def homing_time_s(settings: ControllerSettings) -> float:
    """Longest time $H may take: each axis searches 1.5 times its travel at $25, then at $24 over the pull-off $27.

    Without these settings: five minutes.
    """
    travel, seek, feed = settings.travel_mm, settings.number(25), settings.number(24)
    pull_mm = settings.number(27) or 1.0
    if travel is None or not seek or not feed:
        return 300.0
    search_s = sum(1.5 * length / seek * 60.0 for length in travel)
    locate_s = 3 * 2 * (10.0 * pull_mm / feed * 60.0)
    return 15.0 + SLACK * (search_s + locate_s)
