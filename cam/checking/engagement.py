"""Judges the engagement of the cutter: on which side and over how much of its width it cuts. It must never plunge with
its dead centre.

The spindle turns clockwise seen from above, so a cutter climbs if the stock lies on the right of its path. The volume
that a stretch of path removes, over its length, is the section of the cut. In a slot it is the segment of a circle,
half of it on either side; twice the lesser side, over that segment, separates slots (the first row of a layer, a
transit through stock) from rows beside the last one and from flanks that follow a wall, which cut on one side.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cam.checking.move_rules import Finding
from cam.checking.removal import Drops
from cam.checking.sweep import LEFT, REACH, RIGHT
from cam.passes import PassSpec
from cam.reading.gcode import MoveBatch
from optics.heightfield import Array
from phrases.phrase import Phrase

SLOT_SHARE = 0.6
"""Share of a slot's section, equal on both sides, above which a cut counts as full width."""

SLOT_DEPTH = 0.25
"""Share of the step-down: shallower slots are scratches in the finishing allowance and do not count."""

SLOW_DEPTH, SLOW_FEED = 0.6, 0.6
"""A slot deeper than this share of the step-down must not be cut at more than this share of the feed."""

FAST_ALLOWED_RADII = 4.0
"""Length of such slots, in radii of the ball, that a whole program may have: turns and links at the ends of runs."""

PLUNGE_ALLOWED = 0.15
"""Share of the ball's radius: the centre pushes aside a scratch of this depth."""

_GROUP_CELLS = 6  # length of a stretch: shorter moves sweep too few cells for a section
_STILL_MM = 1e-9
# State of a stretch that is being gathered, carried from batch to batch.
_LENGTH, _LEFT, _RIGHT, _DEEPEST, _FEED, _LINE, _X, _Y = range(8)
# The findings: length of slots, the deepest of them; length of fast deep ones; feed, line and place of the fastest.
_SLOT_LENGTH, _SLOT_DEPTH, _FAST_LENGTH, _FAST_FEED, _FAST_LINE, _FAST_X, _FAST_Y = range(7)


@njit(cache=True, nogil=True)
def _slot_section(depth, radius, corner):  # type: ignore[no-untyped-def]
    """Return the section of a full-width cut this deep: segments of the corner's circle beside the flat part, walls
    above.
    """
    flat = 2.0 * (radius - corner) * depth
    if depth >= corner:
        return flat + 0.5 * math.pi * corner**2 + 2.0 * corner * (depth - corner)
    rise = corner - depth
    return flat + corner**2 * math.acos(rise / corner) - rise * math.sqrt(corner**2 - rise**2)


@njit(cache=True, nogil=True)
def _gather(points, idle, feed, line, depth, left, right, radius, corner, group, least, deep, fast, state, found):  # type: ignore[no-untyped-def] # fmt: skip
    """Judge the path by stretches `group` long; the remainder waits in `state` for the next batch."""
    for k in range(line.size):
        length = math.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
        if idle[k] or length < _STILL_MM:
            state[:] = 0.0
            continue
        state[_LENGTH] += length
        state[_LEFT] += left[k]
        state[_RIGHT] += right[k]
        if left[k] + right[k] > 0.0:  # the mean over the volume: a row beside a turn takes hardly anything off
            state[_FEED] += (feed[k] - state[_FEED]) * (left[k] + right[k]) / (state[_LEFT] + state[_RIGHT])
        if depth[k] >= state[_DEEPEST]:
            state[_DEEPEST], state[_LINE], state[_X], state[_Y] = depth[k], line[k], points[k + 1, 0], points[k + 1, 1]
        if state[_LENGTH] < group:
            continue
        section = 2.0 * min(state[_LEFT], state[_RIGHT]) / state[_LENGTH]
        at_work = section / max(_slot_section(state[_DEEPEST], radius, corner), 1e-12)
        if state[_DEEPEST] > least and at_work > SLOT_SHARE:
            found[_SLOT_LENGTH] += state[_LENGTH]
            found[_SLOT_DEPTH] = max(found[_SLOT_DEPTH], state[_DEEPEST])
            if state[_DEEPEST] > deep and state[_FEED] > fast:
                found[_FAST_LENGTH] += state[_LENGTH]
                if state[_FEED] > found[_FAST_FEED]:
                    found[_FAST_FEED], found[_FAST_LINE] = state[_FEED], state[_LINE]
                    found[_FAST_X], found[_FAST_Y] = state[_X], state[_Y]
        state[:] = 0.0


class Engagement:
    """Watches one program, batch by batch.

    climb_share    : share of the removed volume that lay on the right of the path
    slot_length_mm : path cut at full width, deeper than a scratch; slot_depth_mm: the deepest of it
    flute_need_mm  : greatest height above the tip at which stock was cut
    """

    def __init__(self, spec: PassSpec, *, cell_mm: float) -> None:
        self._spec, self._group_mm = spec, _GROUP_CELLS * cell_mm
        self._state, self._found = np.zeros(8), np.zeros(7)
        self._left_mm3 = self._right_mm3 = 0.0
        self._dropped, self._last_line, self._last_point = False, 0, np.zeros(3)  # the last move of the batch before
        self.flute_need_mm = 0.0
        self._plunge_allowed_mm = PLUNGE_ALLOWED * spec.radius_mm
        self._plunge = Finding(
            says=lambda v: Phrase(
                "goes straight down {depth_mm:.3f} mm deep into stock (allowed: {allowed_mm:g} mm; the centre of a "
                "ball does not cut, nor does that of every flat mill, so the cutter must enter on a ramp or a "
                "helix)",
                depth_mm=v,
                allowed_mm=self._plunge_allowed_mm,
            )
        )

    def add(self, batch: MoveBatch, drops: Drops) -> None:
        if len(batch) == 0:
            return
        spec, tally = self._spec, drops.tally
        left_mm3, right_mm3 = tally[1:, LEFT], tally[1:, RIGHT]
        self._left_mm3 += float(left_mm3.sum())
        self._right_mm3 += float(right_mm3.sum())
        self.flute_need_mm = max(self.flute_need_mm, float(tally[:, REACH].max()))
        _gather(
            *(batch.points_mm, batch.is_rapid | (batch.pause_s >= 0), batch.feed_mm_per_min, batch.line),
            *(
                drops.depth_mm[1:],
                left_mm3,
                right_mm3,
                spec.radius_mm,
                spec.shape.corner_mm(spec.radius_mm),
                self._group_mm,
            ),
            *(SLOT_DEPTH * spec.step_down_mm, SLOW_DEPTH * spec.step_down_mm, SLOW_FEED * spec.feed_mm_per_min),
            *(self._state, self._found),
        )
        self._note_plunges(batch, drops.depth_mm)

    def _note_plunges(self, batch: MoveBatch, depth_mm: Array) -> None:
        step = batch.end_mm - batch.start_mm
        down = (np.abs(step[:, :2]).max(axis=1) < _STILL_MM) & (step[:, 2] < 0) & ~batch.is_rapid
        guilty = np.concatenate([[self._dropped], down]) & (depth_mm > self._plunge_allowed_mm)
        lines = np.concatenate([[self._last_line], batch.line])
        self._plunge.note_moves(guilty, depth_mm, lines, np.concatenate([[self._last_point], batch.end_mm]))
        moving = np.flatnonzero((step != 0).any(axis=1))
        if moving.size:
            k = moving[-1]
            self._dropped, self._last_line, self._last_point = bool(down[k]), int(batch.line[k]), batch.end_mm[k].copy()

    @property
    def climb_share(self) -> float:
        whole = self._left_mm3 + self._right_mm3
        return self._right_mm3 / whole if whole > 0 else 0.0

    @property
    def slot_length_mm(self) -> float:
        return float(self._found[_SLOT_LENGTH])

    @property
    def slot_depth_mm(self) -> float:
        return float(self._found[_SLOT_DEPTH])

    @property
    def faults(self) -> list[Phrase]:
        found, spec = self._found, self._spec
        allowed_mm = FAST_ALLOWED_RADII * spec.radius_mm
        if found[_FAST_LENGTH] <= allowed_mm:
            return self._plunge.sentences
        return [
            *self._plunge.sentences,
            Phrase(
                "line {line} at X{x_mm:.3f} Y{y_mm:.3f} cuts at its full width at {feed_mm_per_min:.0f} mm/min, and so "
                "do {length_mm:.1f} mm in all (allowed: {allowed_mm:g} mm; deeper than {deep_mm:.3g} mm at most "
                "{slow_mm_per_min:.0f} mm/min)",
                line=int(found[_FAST_LINE]),
                x_mm=found[_FAST_X],
                y_mm=found[_FAST_Y],
                feed_mm_per_min=found[_FAST_FEED],
                length_mm=found[_FAST_LENGTH],
                allowed_mm=allowed_mm,
                deep_mm=SLOW_DEPTH * spec.step_down_mm,
                slow_mm_per_min=SLOW_FEED * spec.feed_mm_per_min,
            ),
        ]
