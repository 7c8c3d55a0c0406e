"""Where the tool really goes: a program's cutting moves as chains of tips, on the machine's steps and with its noise.

A move ends where the program says, rounded to the step of each axis; between its ends it is straight: what the steps
within it do to slopes is added to facets, see `stepping`. Rapids and moves straight up or down cut no surface, so they
only part one chain from the next.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cam.as_milled.machine_errors import Noise, Screws
from cam.moves import Array
from cam.reading.gcode import MoveBatch

_STILL_MM = 1e-7  # a move shorter than this in plan is vertical


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Tips of one ball in the order of the program.

    tips_mm (n, 3)  : work frame
    joined (n,)     : bool; the tool cut its way to this tip from the one before
    """

    radius_mm: float
    tips_mm: Array
    joined: NDArray[np.bool_]

    @classmethod
    def of_program(
        cls, batches: Iterable[MoveBatch], *, radius_mm: float, step_mm: float = 0.0, noise: Noise | None = None
    ) -> Tracks:
        """Return the tracks of a program as `cam.reading.gcode.read_program` gives it.

        step_mm : of every axis, 0 for none
        noise   : height errors of the machine; None for none
        """
        pieces, flags = [np.empty((0, 3))], [np.empty(0, dtype=np.bool_)]
        open_end = False
        for batch in batches:
            tips, joined, open_end = _cuts_of(batch, open_end)
            pieces.append(tips)
            flags.append(joined)
        tracks = cls(radius_mm=radius_mm, tips_mm=np.concatenate(pieces), joined=np.concatenate(flags))
        del pieces
        return tracks.made_by(step_mm=step_mm, noise=noise)

    def made_by(self, *, step_mm: float = 0.0, noise: Noise | None = None, screws: Screws | None = None) -> Tracks:
        """Return the same tracks as a machine with such steps, such noise and such screws runs them."""
        tips = np.round(self.tips_mm / step_mm) * step_mm if step_mm > 0 else self.tips_mm.copy()
        if noise is not None and noise.sigma_mm > 0:
            tips[:, 2] += noise.errors_mm(self.tips_mm, self.joined)
        if screws is not None:
            tips += screws.errors_mm(self.tips_mm)
        return Tracks(radius_mm=self.radius_mm, tips_mm=tips, joined=self.joined)

    def divide(self, longest_mm: float) -> Tracks:
        """Return the same tracks with no chord longer than that; a chord that does not move in plan is left out."""
        count = _count(self.tips_mm, self.joined, longest_mm)
        tips, joined = np.empty((count, 3)), np.empty(count, dtype=np.bool_)
        _divide(self.tips_mm, self.joined, longest_mm, tips, joined)
        return Tracks(radius_mm=self.radius_mm, tips_mm=tips, joined=joined)


def _cuts_of(batch: MoveBatch, open_end: bool) -> tuple[Array, NDArray[np.bool_], bool]:
    """Return the tips of the cutting moves of a batch; open_end: the last tip of the batch before is the first here.

    With the spindle off nothing is cut: that is a trace in the air.
    """
    points = batch.points_mm
    along = np.hypot(*(points[1:, :2] - points[:-1, :2]).T) > _STILL_MM
    cuts = ~batch.is_rapid & (batch.pause_s < 0) & along & batch.spindle_on
    arrives = np.concatenate([[False], cuts])
    leaves = np.concatenate([cuts, [False]])
    kept = arrives | leaves
    still_open = bool(cuts[-1]) if cuts.size else open_end
    if open_end and kept.size:
        kept[0] = False
    return points[kept], arrives[kept], still_open


@njit(cache=True, nogil=True)
def _parts(tips, k, longest):  # type: ignore[no-untyped-def]
    length = np.hypot(tips[k, 0] - tips[k - 1, 0], tips[k, 1] - tips[k - 1, 1])
    return 0 if length < _STILL_MM else int(np.ceil(length / longest - 1e-9))


@njit(cache=True, nogil=True)
def _count(tips, joined, longest):  # type: ignore[no-untyped-def]
    count = 0
    for k in range(joined.size):
        count += _parts(tips, k, longest) if joined[k] else 1
    return count


@njit(cache=True, nogil=True)
def _divide(tips, joined, longest, out, flags):  # type: ignore[no-untyped-def]
    count = 0
    for k in range(joined.size):
        if not joined[k]:
            for d in range(3):
                out[count, d] = tips[k, d]
            flags[count] = False
            count += 1
            continue
        parts = _parts(tips, k, longest)
        if parts == 0:
            out[count - 1, 2] = min(out[count - 1, 2], tips[k, 2])
        for m in range(1, parts + 1):
            for d in range(3):
                out[count, d] = tips[k - 1, d] + (tips[k, d] - tips[k - 1, d]) * (m / parts)
            flags[count] = True
            count += 1
