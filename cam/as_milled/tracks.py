"""The tool's real path: a program's cutting moves as chains of tips, on the machine's steps and with its errors.

A move ends where the program says, rounded to the step of each axis; between its ends it is straight; the effect of the
steps within it on slopes is added to facets, see `stepping`. Rapids and vertical moves cut no surface, so they only
separate chains.

Two kinds of errors: heights are off by one value per row, or wander along an unbroken path (paper, Fig. 15c); and
screws move an axis a little too far and too short once in every turn.

The chords of all tracks lie in square boxes by their middles, so that the neighbours of one are found at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cam.moves import Array
from cam.passes import PassSpec
from cam.reading.gcode import MoveBatch

WANDER_MM = 10.0
"""Along a path without entries the error persists for about this distance: the error of a heavy axis, not of chatter.
This is a guess, and a harmless one: rows of a 1 mm ball at pitch 0.05 mm over 16 mm, 0.5 µm of noise. Against the light
of the design 22.5, 22.6, 22.7 dB for 5, 10, 20 mm (22.9 without noise, 22.5 with one error a row), slopes across 19.4,
18.8, 17.9 mrad (14.5, 19.5); along the path 1.9, 1.4, 1.1 mrad.
"""

SEED = 20140511
_PER_TURN = 16  # pieces of a chord, so that it follows the wave

_STILL_MM = 1e-7  # a move shorter than this in plan is vertical


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Gaussian errors of the tip's height, the same for the same seed.

    sigma_mm  : standard deviation
    rows_run  : "x" or "y": each row of that direction has an error of its own (a collision at its beginning that is
                carried along, as in the paper); None: an error that is new at every entry and wanders along the path
    wander_mm : length after which a wandering error has lost 63 % of its memory
    """

    sigma_mm: float
    rows_run: str | None = "x"
    wander_mm: float = WANDER_MM
    seed: int = SEED

    @classmethod
    def of_pass(cls, spec: PassSpec, sigma_mm: float, *, seed: int = SEED) -> Noise:
        return cls(sigma_mm=sigma_mm, rows_run=spec.direction if spec.strategy == "raster" else None, seed=seed)

    def errors_mm(self, tips_mm: Array, joined: NDArray[np.bool_]) -> Array:
        """Return (n,) height errors of tips (n, 3) as programmed."""
        rng = np.random.default_rng(self.seed)
        if self.rows_run is None:
            out: Array = rng.standard_normal(joined.size)
            _wander(tips_mm, joined, self.wander_mm, out)
            return self.sigma_mm * out
        number = _row_numbers(tips_mm[:, 1 if self.rows_run == "x" else 0], joined)
        return np.asarray(self.sigma_mm * rng.standard_normal(int(number[-1]) + 1 if number.size else 0)[number])


def _row_numbers(across_mm: Array, joined: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return row numbers (n,) of tips: each stretch of equal `across_mm` is a row; tips between two rows belong to the
    one before.
    """
    along = np.zeros(across_mm.size, dtype=np.bool_)
    along[1:] = joined[1:] & (np.diff(across_mm) == 0.0)
    begins = along.copy()
    begins[1:] &= ~along[:-1]
    number = np.cumsum(begins)
    number[:-1] += begins[1:]  # the first tip of a row comes before its first chord
    return np.maximum(number, 0)


@njit(cache=True, nogil=True)
def _wander(tips: Array, joined: NDArray[np.bool_], wander: float, out: Array) -> None:
    """Turn independent unit normals into an Ornstein-Uhlenbeck walk of unit variance along each chain, in place."""
    for k in range(joined.size):
        if joined[k]:
            way = math.hypot(tips[k, 0] - tips[k - 1, 0], tips[k, 1] - tips[k - 1, 1])
            kept = math.exp(-way / wander)
            out[k] = kept * out[k - 1] + math.sqrt(1.0 - kept * kept) * out[k]


@dataclass(frozen=True, slots=True, kw_only=True)
class Screws:
    """Triples are X, Y, Z.

    error_mm : amplitude of the error of an axis
    lead_mm  : travel of the axis per turn of its screw
    """

    error_mm: tuple[float, float, float]
    lead_mm: tuple[float, float, float]

    @property
    def longest_mm(self) -> float:
        """Greatest length in plan of a chord that still follows the waves of X and Y, and of Z on slopes up to 1."""
        leads = [lead for error, lead in zip(self.error_mm, self.lead_mm, strict=True) if error > 0]
        return min(leads, default=math.inf) / _PER_TURN

    def errors_mm(self, tips_mm: Array) -> Array:
        """Return the errors of tips (n, 3). The phase of a screw at zero is not known and is taken as 0."""
        return np.asarray(np.array(self.error_mm) * np.sin(2.0 * np.pi * tips_mm / np.array(self.lead_mm)))


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
        """Return the tracks of a program as `cam.reading.gcode.read_parts` gives it.

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
        return tracks.run_on_mill(step_mm=step_mm, noise=noise)

    def run_on_mill(self, *, step_mm: float = 0.0, noise: Noise | None = None, screws: Screws | None = None) -> Tracks:
        """Return the same tracks as run by a machine with these steps, this noise and these screws."""
        tips = np.round(self.tips_mm / step_mm) * step_mm if step_mm > 0 else self.tips_mm.copy()
        if noise is not None and noise.sigma_mm > 0:
            tips[:, 2] += noise.errors_mm(self.tips_mm, self.joined)
        if screws is not None:
            tips += screws.errors_mm(self.tips_mm)
        return Tracks(radius_mm=self.radius_mm, tips_mm=tips, joined=self.joined)

    def divide(self, longest_mm: float) -> Tracks:
        """Return the same tracks with no chord longer than the limit; chords without motion in plan are left out."""
        count = _count(self.tips_mm, self.joined, longest_mm)
        tips, joined = np.empty((count, 3)), np.empty(count, dtype=np.bool_)
        _divide(self.tips_mm, self.joined, longest_mm, tips, joined)
        return Tracks(radius_mm=self.radius_mm, tips_mm=tips, joined=joined)


def _cuts_of(batch: MoveBatch, open_end: bool) -> tuple[Array, NDArray[np.bool_], bool]:
    """Return the tips of the cutting moves of a batch; open_end: the last tip of the batch before is the first here.

    With the spindle off nothing is cut: such moves are a trace in the air.
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


class Chords(NamedTuple):
    """The chords in the form of the kernels. Chord k runs from tip k - 1 to tip k, where `joined[k]`.

    group (n,) uint8 : which ball runs it; radii (groups,)
    start (boxes + 1,), member : CSR of chords by box; boxes (rows, columns) of `side` from (x0, y0)
    half_x, half_y             : no chord reaches farther from its middle than this
    """

    tips: Any
    joined: Any
    group: Any
    radii: Any
    half_x: float
    half_y: float
    start: Any
    member: Any
    x0: float
    y0: float
    side: float
    columns: int
    rows: int


def sort_chords(tracks: Sequence[Tracks], *, side_mm: float) -> Chords:
    tips = tracks[0].tips_mm if len(tracks) == 1 else np.concatenate([one.tips_mm for one in tracks])
    joined = tracks[0].joined if len(tracks) == 1 else np.concatenate([one.joined for one in tracks])
    group = np.repeat(np.arange(len(tracks), dtype=np.uint8), [one.joined.size for one in tracks])
    if not joined.any():
        raise ValueError("there are no cutting moves")
    low, high = tips.min(axis=0), tips.max(axis=0)
    columns, rows = (int((high[d] - low[d]) / side_mm) + 1 for d in (0, 1))
    start = np.zeros(columns * rows + 1, dtype=np.int32)
    member = np.empty(int(joined.sum()), dtype=np.int32)
    _sort(tips, joined, float(low[0]), float(low[1]), side_mm, columns, start, member)
    half_x, half_y = _half_sizes(tips, joined)
    return Chords(
        tips=tips,
        joined=joined,
        group=group,
        radii=np.array([one.radius_mm for one in tracks]),
        half_x=half_x,
        half_y=half_y,
        start=start,
        member=member,
        x0=float(low[0]),
        y0=float(low[1]),
        side=side_mm,
        columns=columns,
        rows=rows,
    )


@njit(cache=True, nogil=True)
def _half_sizes(tips, joined):  # type: ignore[no-untyped-def]
    wide = high = 0.0
    for k in range(1, joined.size):
        if joined[k]:
            wide = max(wide, 0.5 * abs(tips[k, 0] - tips[k - 1, 0]))
            high = max(high, 0.5 * abs(tips[k, 1] - tips[k - 1, 1]))
    return wide, high


@njit(cache=True, nogil=True)
def _box(tips, k, x0, y0, side, columns):  # type: ignore[no-untyped-def]
    i = int((0.5 * (tips[k, 0] + tips[k - 1, 0]) - x0) / side)
    j = int((0.5 * (tips[k, 1] + tips[k - 1, 1]) - y0) / side)
    return j * columns + i


@njit(cache=True, nogil=True)
def _sort(tips, joined, x0, y0, side, columns, start, member):  # type: ignore[no-untyped-def]
    """Sort by counting, in the order of the tracks within a box."""
    for k in range(1, joined.size):
        if joined[k]:
            start[_box(tips, k, x0, y0, side, columns) + 1] += 1
    for b in range(start.size - 1):
        start[b + 1] += start[b]
    for k in range(1, joined.size):
        if joined[k]:
            b = _box(tips, k, x0, y0, side, columns)
            member[start[b]] = k
            start[b] += 1
    for b in range(start.size - 1, 0, -1):
        start[b] = start[b - 1]
    start[0] = 0


@njit(cache=True, nogil=True)
def gather(c, k, nx, ny, reach, room, out):  # type: ignore[no-untyped-def]
    """Gather the other chords that cut within about `reach` of chord k; return their number, at most `room`.

    nx, ny : of the surface's unit normal there. A ball that is larger by d touches the same place d (nx, ny) aside
    """
    ax, ay = c.tips[k - 1, 0], c.tips[k - 1, 1]
    bx, by = c.tips[k, 0], c.tips[k, 1]
    half = 0.5 * math.hypot(bx - ax, by - ay)
    far_x, far_y = reach + c.half_x + 0.5 * abs(bx - ax), reach + c.half_y + 0.5 * abs(by - ay)
    ex, ey = (bx - ax) / (2.0 * half), (by - ay) / (2.0 * half)
    count = 0
    for group in range(c.radii.size):
        larger = c.radii[group] - c.radii[c.group[k]]
        mx, my = 0.5 * (ax + bx) + larger * nx, 0.5 * (ay + by) + larger * ny
        i0 = max(int((mx - far_x - c.x0) / c.side), 0)
        i1 = min(int((mx + far_x - c.x0) / c.side), c.columns - 1)
        j0 = max(int((my - far_y - c.y0) / c.side), 0)
        j1 = min(int((my + far_y - c.y0) / c.side), c.rows - 1)
        for j in range(j0, j1 + 1):
            for m in range(c.start[j * c.columns + i0], c.start[j * c.columns + max(i1, i0 - 1) + 1]):
                n = c.member[m]
                if n == k or c.group[n] != group:
                    continue
                px, py = c.tips[n - 1, 0] - mx, c.tips[n - 1, 1] - my
                qx, qy = c.tips[n, 0] - mx, c.tips[n, 1] - my
                u0, w0 = px * ex + py * ey, py * ex - px * ey
                u1, w1 = qx * ex + qy * ey, qy * ex - qx * ey
                beside = min(w0, w1) > reach or max(w0, w1) < -reach
                if beside or min(u0, u1) > half + reach or max(u0, u1) < -half - reach:
                    continue
                if count < room:
                    out[count] = n
                    count += 1
    return count
