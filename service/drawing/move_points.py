"""Moves of a program as points of a path, each with its time on the mill."""

from __future__ import annotations

import numpy as np

from cam.duration import DurationModel, Kinematics, is_block
from cam.reading.gcode import MoveBatch
from service.drawing.points import PAUSE, RAPID, Points


class MovePoints:
    """Takes the batches of a program; gives points as soon as look-ahead knows when the mill is there.

    Moves that go nowhere and take no time make none. `time_s`: of the last point given.
    """

    def __init__(self, kinematics: Kinematics) -> None:
        self._model = DurationModel(kinematics)
        self._waiting = Points.none()
        self._begun = False

    def add(self, batch: MoveBatch) -> Points:
        if not len(batch):
            return Points.none()
        chosen = is_block(batch)
        made = Points(
            mm=batch.end_mm[chosen],
            time_s=np.empty(np.count_nonzero(chosen)),
            line=batch.line[chosen],
            kind=np.where(batch.pause_s[chosen] >= 0.0, PAUSE, batch.is_rapid[chosen] * RAPID).astype(np.uint8),
        )
        first = Points.none() if self._begun else _beginning(batch)
        self._begun = True
        ends_s = self._model.timed(batch)
        held = Points.joined([self._waiting, made])
        self._waiting = held[len(ends_s) :]
        return Points.joined([first, _timed(held[: len(ends_s)], ends_s)])

    def rest(self) -> Points:
        """What was waiting for moves that do not come any more."""
        waiting, self._waiting = self._waiting, Points.none()
        return _timed(waiting, self._model.waiting_s())

    @property
    def seconds(self) -> float:
        """Of the whole program so far."""
        return self._model.seconds


def _beginning(batch: MoveBatch) -> Points:
    return Points(
        mm=batch.points_mm[:1], time_s=np.zeros(1), line=batch.line[:1], kind=np.full(1, RAPID, dtype=np.uint8)
    )


def _timed(points: Points, ends_s: np.ndarray) -> Points:
    """With those times; without stops that take no time."""
    timed = Points(mm=points.mm, time_s=ends_s, line=points.line, kind=points.kind)
    stops = timed.kind == PAUSE
    if not stops.any():
        return timed
    took = np.diff(ends_s, prepend=-np.inf) > 0.0
    return timed[~stops | took]
