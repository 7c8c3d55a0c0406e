"""Measures the chip per tooth of a program: feed over speed and flutes, over the time in which the cutter removes
stock, and compares it with the band of the material.

Cutter makers tabulate the feed per tooth, so this is compared with their bands. The chip itself is
thinner: a ball of radius R at a depth of cut a makes at most sqrt(1 - (1 - a / R)^2) of it, 0.87 in layers of R / 2,
0.36 in a finish that takes R / 15 off; makers' figures for such cuts take that into account. The feed is the one that
the mill reaches in the model of the program's time: less than the written feed while it speeds up, brakes or waits for
lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cam.checking.removal import Drops
from cam.duration import is_block
from cam.passes import PassSpec
from cam.reading.gcode import MoveBatch
from optics.heightfield import Array

_CUTS_MM = 1e-3
"""Removing less stock than this is rounding, not a cut."""

_ROUNDED = 0.01  # feeds and speeds are whole numbers

_LENGTH, _FEED, _TEETH, _LINE, _X, _Y = range(6)  # columns of a block; _TEETH: a minute, 0 where nothing is cut


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipTime:
    """How long a program cuts [s] with chips below, within and above the band, and where it cuts thinnest.

    thinnest_mm : mean chip of the time below the band; written_mm: the chip of the written feed there
    line, x_mm, y_mm : end of the longest stretch below the band; line 0: none
    """

    seconds: tuple[float, float, float]
    thinnest_mm: float
    written_mm: float
    line: int
    x_mm: float
    y_mm: float

    @property
    def share(self) -> float:
        """Share of the cutting time whose chips are within the band."""
        return self.seconds[1] / sum(self.seconds) if sum(self.seconds) > 0 else 1.0


class Chips:
    """Watches one program, batch by batch."""

    def __init__(self, spec: PassSpec) -> None:
        self._spec = spec
        self._waiting = np.empty((0, 6))  # blocks whose time is not certain yet
        self._ended_s = 0.0
        self._seconds, self._thin_mm_s = np.zeros(3), np.zeros(2)
        self._longest_s, self._place = 0.0, np.zeros(3)

    def add(self, batch: MoveBatch, drops: Drops, done_s: Array) -> None:
        """Add a batch. done_s : ends of the blocks that are certain now, as `DurationModel.add_batch` returns them."""
        cuts = (drops.depth_mm[1:] > _CUTS_MM) & ~batch.is_rapid & (batch.pause_s < 0.0)
        blocks = np.column_stack(
            (
                np.linalg.norm(batch.end_mm - batch.start_mm, axis=1),
                batch.feed_mm_per_min,
                np.where(cuts, batch.spindle_rpm * self._spec.flutes, 0.0),
                batch.line,
                batch.end_mm[:, :2],
            )
        )
        self._waiting = np.concatenate((self._waiting, blocks[is_block(batch)]))
        self._judge(done_s)

    def _judge(self, done_s: Array) -> None:
        blocks, self._waiting = self._waiting[: done_s.size], self._waiting[done_s.size :]
        took_s = np.diff(done_s, prepend=self._ended_s)
        self._ended_s = float(done_s[-1]) if done_s.size else self._ended_s
        cuts = blocks[:, _TEETH] > 0.0
        blocks, took_s = blocks[cuts], np.maximum(took_s[cuts], 1e-9)
        least_mm, most_mm = self._spec.chip_mm
        written_mm = blocks[:, _FEED] / blocks[:, _TEETH]
        chip_mm = np.minimum(written_mm, 60 * blocks[:, _LENGTH] / took_s / blocks[:, _TEETH])
        place = 1 + (chip_mm > most_mm * (1 + _ROUNDED)) - (chip_mm < least_mm * (1 - _ROUNDED))
        self._seconds += np.bincount(place, weights=took_s, minlength=3)
        thin_s = np.where(place == 0, took_s, 0.0)
        self._thin_mm_s += np.stack((chip_mm, written_mm)) @ thin_s
        if thin_s.any():
            firsts = np.flatnonzero(np.diff(place == 0, prepend=place[0] != 0))  # of stretches
            stretches_s = np.add.reduceat(thin_s, firsts)
            longest = int(np.argmax(stretches_s))
            if stretches_s[longest] > self._longest_s:
                last = np.append(firsts, place.size)[longest + 1] - 1
                self._longest_s, self._place = float(stretches_s[longest]), blocks[last, _LINE:]

    def finish(self, waiting_s: Array) -> ChipTime:
        """Return the result. waiting_s : ends of the last blocks."""
        self._judge(waiting_s)
        line, x_mm, y_mm = map(float, self._place)
        below_s, within_s, above_s = map(float, self._seconds)
        thinnest_mm, written_mm = map(float, self._thin_mm_s / below_s if below_s else self._thin_mm_s)
        return ChipTime(
            seconds=(below_s, within_s, above_s),
            thinnest_mm=thinnest_mm,
            written_mm=written_mm,
            line=int(line),
            x_mm=x_mm,
            y_mm=y_mm,
        )
