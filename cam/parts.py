"""Splits one pass into several programs: each is complete, and continues exactly where the one before ended.

Theory of operation: paths are written in slices. A program that has grown to its limit ends at the next lift of the
path, or else outside the aperture, where no light goes, or else where it stands. The tool lifts straight up from the
last point. The next program comes down onto the path a few millimetres before that point, where the ball has its own
slot to come down in, sinks along the path without touching anything, and cuts the last millimetre once more before it
goes on: no mark, no gap. Memory does not grow with the pass.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from cam.moves import CLEARANCE_MM, RAPID_CLEARANCE_MM, Array, Motion, Path, cut, rapid
from cam.posts.dialects import Dialect
from cam.posts.post import ProgramSetup
from cam.posts.remarks import describe_part
from cam.posts.writers import create_writer
from cam.rows.entries import RAMP_SLOPE, leave

OVERLAP_MM = 1.0
"""Length of the path that is cut again after an entry in the middle."""

AT_LIFT, OUTSIDE = 0.85, 0.93
"""Share of its limit from which a program may end at a lift, and outside the aperture."""

_SPARE_BYTES = 400  # for the lift and the end
_SPARE_SHARE = 0.03  # and for the slice that is being written
_FEWEST_POINTS, _FEW_POINTS, _MOST_POINTS = 10, 100, 1 << 20  # written between two checks of the limits
_BYTES_PER_POINT = 48
_RECENT_MM = OVERLAP_MM + CLEARANCE_MM / RAMP_SLOPE


@dataclass(frozen=True, slots=True, kw_only=True)
class PartLimits:
    """The most that one program may hold. rapid_mm_per_min: for the time of rapids; cuts run at their feed."""

    most_bytes: float = math.inf
    most_s: float = math.inf
    rapid_mm_per_min: float = 3000.0

    @property
    def any(self) -> bool:
        return not (math.isinf(self.most_bytes) and math.isinf(self.most_s))

    def points_at_once(self) -> int:
        """Return a number of points small enough that a program near its limit cannot exceed it between two checks."""
        room = 0.01 * self.most_bytes / _BYTES_PER_POINT
        return int(min(max(room, _FEWEST_POINTS), _FEW_POINTS))


@dataclass(frozen=True, slots=True, kw_only=True)
class PassFrame:
    """The common beginning and end of all programs of a pass. aperture_mm: width and height of the lens.

    trace : paths in the air before the first cut; they, and the warm-up of `setup`, are for the first program alone
    """

    remarks: tuple[str, ...]
    rpm: float
    plunge_mm_per_min: float
    safe_z_mm: float
    aperture_mm: tuple[float, float]
    number: int = 1
    setup: ProgramSetup = field(default_factory=ProgramSetup)
    trace: tuple[Path, ...] = ()


def programs(
    paths: Iterable[Path], post: Dialect, frame: PassFrame, limits: PartLimits | None = None
) -> Iterator[Iterator[bytes]]:
    """Yield the text of each program, in pieces; read each to its end before you ask for the next."""
    limits = limits or PartLimits()
    source = _Slices(paths, limits)
    part = 0
    while part == 0 or source.has_more:
        part += 1
        yield _write_program(source, post, frame, limits, part)


def _write_program(source: _Slices, post: Dialect, frame: PassFrame, limits: PartLimits, part: int) -> Iterator[bytes]:
    writer, meter = create_writer(post), _Meter(limits)
    remarks = frame.remarks if part == 1 else (*frame.remarks, describe_part(part))
    setup, trace = (frame.setup, frame.trace) if part == 1 else (frame.setup.without_warm_up(), ())
    number = 100 * frame.number + part
    first = writer.start(remarks, rpm=frame.rpm, safe_z_mm=frame.safe_z_mm, program=number, setup=setup, trace=trace)
    meter.count_text(first)
    yield first
    for path in _way_back(source, frame):
        for text in writer.write(path):
            meter.count_text(text)
            yield text
    for path in source:
        for text in writer.write(path):
            meter.count_text(text)
            yield text
        if not limits.any:
            continue
        meter.count_path(path, source.length_mm)
        source.points_at_once = meter.points_at_once()
        place = source.place
        aloft = path.motion is Motion.RAPID and place[2] >= frame.safe_z_mm - 1e-9
        if source.has_more and meter.share >= (AT_LIFT if aloft else OUTSIDE if _outside(place, frame) else 1.0):
            if not aloft:
                yield from writer.write(leave(place[0], place[1], safe_z_mm=frame.safe_z_mm))
            break
    yield writer.end(safe_z_mm=frame.safe_z_mm, setup=setup)


def _outside(place: Array, frame: PassFrame) -> bool:
    width_mm, height_mm = frame.aperture_mm
    return not (0.0 <= place[0] <= width_mm and 0.0 <= place[1] <= height_mm)


def _way_back(source: _Slices, frame: PassFrame) -> Iterator[Path]:
    """Yield paths back to the tool's last position: aloft, or down onto the last path and along it to its end."""
    recent = source.recent()
    if recent is None:
        if not source.begins_aloft:
            yield rapid(source.place)
        return
    points, feed_mm_per_min = recent
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    meets = float(run[max(0, int(np.searchsorted(run, run[-1] - OVERLAP_MM, side="right")) - 1)])  # at a vertex
    begin = max(0.0, meets - CLEARANCE_MM / RAMP_SLOPE)
    places = np.union1d(run[run >= begin], [begin])
    way = np.column_stack([np.interp(places, run, points[:, axis]) for axis in range(3)])
    way[-1] = points[-1]
    exact = places >= meets
    sinking = way[~exact] if begin < meets else way[:1].copy()
    sinking[:, 2] += CLEARANCE_MM - RAMP_SLOPE * (places[: len(sinking)] - begin)
    x, y, z = sinking[0]
    over_mm = min(max(z, 0.0) + RAPID_CLEARANCE_MM, frame.safe_z_mm)
    yield rapid((x, y, frame.safe_z_mm), (x, y, over_mm))
    yield cut(sinking, min(frame.plunge_mm_per_min, feed_mm_per_min))
    yield cut(way[exact], feed_mm_per_min)


class _Meter:
    """The part of its limits that a program has used."""

    def __init__(self, limits: PartLimits) -> None:
        self._limits = limits
        self._most_bytes = limits.most_bytes * (1 - _SPARE_SHARE) - _SPARE_BYTES
        self._bytes, self._seconds, self._points = 0, 0.0, 0

    def count_text(self, text: bytes) -> None:
        self._bytes += len(text)

    def count_path(self, path: Path, length_mm: float) -> None:
        self._points += len(path.points_mm)
        self._seconds += 60 * length_mm / (path.feed_mm_per_min or self._limits.rapid_mm_per_min)

    def points_at_once(self) -> int:
        """Return a quarter of the points that still fit until the program may end, estimated from those so far."""
        fits = self._points * (AT_LIFT / max(self.share, 1e-9) - 1)
        return int(min(max(fits / 4, self._limits.points_at_once()), _MOST_POINTS))

    @property
    def share(self) -> float:
        return max(self._bytes / self._most_bytes, self._seconds / self._limits.most_s)


class _Slices:
    """Paths in slices of a few points, and the last stretch that was cut; whole paths if there are no limits."""

    def __init__(self, paths: Iterable[Path], limits: PartLimits) -> None:
        self._limited = limits.any
        self.points_at_once = limits.points_at_once()
        self._slices = self._slice(paths) if self._limited else iter(paths)
        self._next = next(self._slices, None)
        self._recent: deque[tuple[Path, float]] = deque()  # each with the length of all before its first point
        self._way_mm = 0.0
        self.place = np.full(3, np.nan)
        self.length_mm = 0.0

    @property
    def has_more(self) -> bool:
        return self._next is not None

    @property
    def begins_aloft(self) -> bool:
        """Whether the next path brings the tool to its place by itself: the very first path, or a rapid."""
        return bool(np.isnan(self.place[2])) or self._next is None or self._next.motion is Motion.RAPID

    def __iter__(self) -> Iterator[Path]:
        while (path := self._next) is not None:
            self._next = next(self._slices, None)
            if self._limited:
                self._record(path)
            yield path

    def recent(self) -> tuple[Array, float] | None:
        """Return the last millimetres of the cut that the tool is in (n, 3) and their feed; None if it is not in
        one.
        """
        feed = self._recent[-1][0].feed_mm_per_min if self._recent else None
        if feed is None:
            return None
        return np.concatenate([path.points_mm for path, _ in self._recent]), feed

    def _slice(self, paths: Iterable[Path]) -> Iterator[Path]:
        for path in paths:
            first = 0
            while first < len(path.points_mm):
                end = first + self.points_at_once
                yield Path(
                    motion=path.motion,
                    points_mm=path.points_mm[first:end],
                    feed_mm_per_min=path.feed_mm_per_min,
                )
                first = end

    def _record(self, path: Path) -> None:
        """Move on to the end of a path, and keep the last part of the cuts that an entry in the middle would need."""
        points = path.points_mm
        reach_mm = 0.0 if np.isnan(self.place[2]) else math.dist(self.place, points[0])
        self.length_mm = reach_mm + _length_mm(points)
        begin_mm = self._way_mm + reach_mm
        self._way_mm += self.length_mm
        self.place = points[-1]
        if self._recent and self._recent[-1][0].feed_mm_per_min != path.feed_mm_per_min:  # a rapid has none
            self._recent.clear()
        if path.motion is Motion.CUT:
            self._recent.append((path, begin_mm))
        while len(self._recent) > 1 and self._way_mm - self._recent[1][1] > _RECENT_MM:
            self._recent.popleft()


def _length_mm(points: Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
