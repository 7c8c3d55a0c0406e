"""Joins all tracks into one path on the surface: from the end of each to the cheapest entry of another.

Everything lies on the surface, so joints may cross tracks. A joint is the shortest curve of bounded curvature between
two headings; its length is the cost by which the next track is chosen. A joint to the neighbour at one pitch is
expensive, while one to a track ten pitches away is a half circle. So rows come out interleaved, like a racetrack,
without a rule for that. An open track is entered at either end; a closed one at any of its places, in either sense, and
left where it was entered.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from cam.contour.field import coarseness
from cam.contour.joints import draw, shorten, shortest
from cam.contour.tracer import ContourLines
from cam.moves import Array

TURN_PITCHES, TIGHTEST_PITCHES = 5.5, 0.48
"""Radii of turns: on a small part at a coarse pitch, wide turns would be half the path. The tightest turns lead to the
next track.
"""

PLACES_PITCHES = 25.0
"""Distance between the places at which a closed track may be entered."""

CELL_PITCHES = 16.0
MOST_JOINT_POINTS = 160


class Entries(NamedTuple):
    """Ways into tracks, in buckets of a grid: x, y, heading, the track, the vertex, and the sense (1 or -1).

    bucket_of (ny nx + 1,) : where the entries of a cell begin; `alive` of them are not used up
    """

    pose: Any
    track: Any
    vertex: Any
    sense: Any
    first: Any
    alive: Any
    x0: float
    y0: float
    cell: float
    nx: int
    ny: int


class Room(NamedTuple):
    """The limits of joints: the area (the aperture and a ring around it), and how tightly they may turn."""

    x_from: float
    x_to: float
    y_from: float
    y_to: float
    radius: float


def turn_radius_mm(pitch_mm: float, side_mm: float) -> float:
    """Return the turn radius of joints: wide enough for a mill, unless the lens is only some hundred pitches wide."""
    return pitch_mm * TURN_PITCHES * float((TIGHTEST_PITCHES / TURN_PITCHES) ** coarseness(pitch_mm, side_mm))


def tour_tracks(tracks: ContourLines, room: Room, begin: tuple[float, float, float], *, pitch_mm: float) -> Array:
    """Return (n, 2) a polyline from a pose (x, y, heading) along all tracks and out to the ring."""
    entries = _entries(tracks, room, pitch_mm)
    points = np.empty((len(tracks.xy_mm) + (MOST_JOINT_POINTS + 1) * (tracks.count + 2), 2))
    count = _tour(tracks.xy_mm, tracks.start, entries, room, begin, points)
    return points[:count].copy()


def _entries(tracks: ContourLines, room: Room, pitch_mm: float) -> Entries:
    pose, track, vertex, sense = _ways_in(tracks.xy_mm, tracks.start, PLACES_PITCHES * pitch_mm)
    cell = CELL_PITCHES * pitch_mm
    nx, ny = (math.ceil(side / cell) + 1 for side in (room.x_to - room.x_from, room.y_to - room.y_from))
    i = np.clip(((pose[:, 0] - room.x_from) / cell).astype(np.int64), 0, nx - 1)
    j = np.clip(((pose[:, 1] - room.y_from) / cell).astype(np.int64), 0, ny - 1)
    order = np.argsort(j * nx + i, kind="stable")
    alive = np.bincount(j * nx + i, minlength=nx * ny)
    return Entries(
        pose=pose[order],
        track=track[order],
        vertex=vertex[order],
        sense=sense[order],
        first=np.concatenate([[0], np.cumsum(alive)]),
        alive=alive,
        x0=room.x_from,
        y0=room.y_from,
        cell=cell,
        nx=nx,
        ny=ny,
    )


@njit(cache=True, nogil=True)
def _ways_in(xy, start, apart):  # type: ignore[no-untyped-def]
    """Return poses (n, 3), tracks, vertices and senses of all entries."""
    room = 0
    for k in range(start.size - 1):
        room += 2 * (start[k + 1] - start[k])
    pose = np.empty((room, 3))
    track, vertex, sense = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    count = 0
    for k in range(start.size - 1):
        first, last = start[k], start[k + 1] - 1
        if not _is_closed(xy, first, last):
            for v, way in ((first, 1), (last, -1)):
                h = math.atan2(xy[v + way, 1] - xy[v, 1], xy[v + way, 0] - xy[v, 0])
                pose[count, 0], pose[count, 1], pose[count, 2] = xy[v, 0], xy[v, 1], h
                track[count], vertex[count], sense[count] = k, v, way
                count += 1
            continue
        gone = apart
        for v in range(first, last):
            before = v - 1 if v > first else last - 1
            if gone >= apart:
                gone = 0.0
                h = math.atan2(xy[v + 1, 1] - xy[before, 1], xy[v + 1, 0] - xy[before, 0])
                for way in (1, -1):
                    pose[count, 0], pose[count, 1] = xy[v, 0], xy[v, 1]
                    pose[count, 2] = h if way == 1 else h + math.pi
                    track[count], vertex[count], sense[count] = k, v, way
                    count += 1
            gone += math.hypot(xy[v + 1, 0] - xy[v, 0], xy[v + 1, 1] - xy[v, 1])
    return pose[:count].copy(), track[:count].copy(), vertex[:count].copy(), sense[:count].copy()


@njit(cache=True, nogil=True)
def _find_nearest(e, used, x, y, h, radius):  # type: ignore[no-untyped-def]
    """Return the entry with the shortest joint from a pose, -1 if none is left. Drops used entries on the way."""
    ci = min(max(int((x - e.x0) / e.cell), 0), e.nx - 1)
    cj = min(max(int((y - e.y0) / e.cell), 0), e.ny - 1)
    best, choice = np.inf, -1
    for ring in range(max(e.nx, e.ny)):
        if (ring - 1) * e.cell > best:
            break
        for j in range(max(0, cj - ring), min(e.ny - 1, cj + ring) + 1):
            edge = j == cj - ring or j == cj + ring
            for i in range(ci - ring, ci + ring + 1, 1 if edge else max(1, 2 * ring)):
                if not 0 <= i < e.nx:
                    continue
                b = j * e.nx + i
                k = e.first[b]
                while k < e.first[b] + e.alive[b]:
                    if used[e.track[k]]:
                        _swap(e, k, e.first[b] + e.alive[b] - 1)
                        e.alive[b] -= 1
                        continue
                    px, py, ph = e.pose[k, 0], e.pose[k, 1], e.pose[k, 2]
                    if math.hypot(px - x, py - y) < best:
                        length = shortest(x, y, h, px, py, ph, radius)[0]
                        if length < best:
                            best, choice = length, k
                    k += 1
    return choice


@njit(cache=True, nogil=True)
def _swap(e, a, b):  # type: ignore[no-untyped-def]
    for k in range(3):
        e.pose[a, k], e.pose[b, k] = e.pose[b, k], e.pose[a, k]
    e.track[a], e.track[b] = e.track[b], e.track[a]
    e.vertex[a], e.vertex[b] = e.vertex[b], e.vertex[a]
    e.sense[a], e.sense[b] = e.sense[b], e.sense[a]


@njit(cache=True, nogil=True)
def _join(x, y, h, px, py, ph, room, out, count):  # type: ignore[no-untyped-def]
    """Write the joint's points, except the last, into out[count:]; it turns tighter where the ring is too narrow."""
    radius = room.radius
    for _ in range(12):
        _, word, a, b, c = shortest(x, y, h, px, py, ph, radius)
        end = draw(x, y, h, radius, word, a, b, c, out, count) - 1
        inside = True
        for k in range(count, end):
            inside &= room.x_from <= out[k, 0] <= room.x_to and room.y_from <= out[k, 1] <= room.y_to
        if inside:
            return max(end, count)
        radius *= 0.75
    for k in range(count, end):
        out[k, 0] = min(max(out[k, 0], room.x_from), room.x_to)
        out[k, 1] = min(max(out[k, 1], room.y_from), room.y_to)
    return max(end, count)


@njit(cache=True, nogil=True)
def _is_closed(xy, first, last):  # type: ignore[no-untyped-def]
    return first + 2 < last and xy[first, 0] == xy[last, 0] and xy[first, 1] == xy[last, 1]


@njit(cache=True, nogil=True)
def _choose_stops(xy, start, e, radius, into, out, stops):  # type: ignore[no-untyped-def]
    """Starting at into[0], always go to the nearest track. Write the poses to into[n] and out[n], and the track, its
    first vertex and its sense to stops[n].
    """
    used = np.zeros(start.size - 1, np.bool_)
    out[0] = into[0]
    for n in range(1, start.size):
        k = _find_nearest(e, used, out[n - 1, 0], out[n - 1, 1], out[n - 1, 2], radius)
        track, v, way = e.track[k], e.vertex[k], e.sense[k]
        used[track] = True
        stops[n, 0], stops[n, 1], stops[n, 2] = track, v, way
        into[n] = e.pose[k]
        first, last = start[track], start[track + 1] - 1
        out[n] = e.pose[k]
        if not _is_closed(xy, first, last):
            end = last if way == 1 else first
            out[n, 0], out[n, 1] = xy[end, 0], xy[end, 1]
            out[n, 2] = math.atan2(xy[end, 1] - xy[end - way, 1], xy[end, 0] - xy[end - way, 0])


@njit(cache=True, nogil=True)
def _tour(xy, start, e, room, begin, path):  # type: ignore[no-untyped-def]
    """Write the whole path into path (n, 2); return its number of points."""
    into, out = np.empty((start.size, 3)), np.empty((start.size, 3))
    stops = np.zeros((start.size, 3), np.int64)
    into[0, 0], into[0, 1], into[0, 2] = begin
    _choose_stops(xy, start, e, room.radius, into, out, stops)
    order, turned = np.arange(start.size), np.zeros(start.size, np.bool_)
    shorten(into, out, room.radius, order, turned)
    x, y, h = begin
    path[0, 0], path[0, 1] = x, y
    count = 1
    for n in range(1, start.size):
        k, back = order[n], turned[n]
        track, v, way = stops[k]
        px, py, ph = out[k] if back else into[k]
        count = _join(x, y, h, px, py, ph + math.pi if back else ph, room, path, count)
        first, last = start[track], start[track + 1] - 1
        closed = _is_closed(xy, first, last)
        if back:
            way = -way
            v = v if closed else first + last - v
        for _ in range(last - first + 1):
            path[count, 0], path[count, 1] = xy[v, 0], xy[v, 1]
            count += 1
            v += way
            if closed and v == last and way == 1:
                v = first
            elif closed and v == first - 1:
                v = last - 1
        x, y, h = into[k] if back else out[k]
        h = h + math.pi if back else h
    return _out_to_ring(x, y, h, room, path, count)


@njit(cache=True, nogil=True)
def _out_to_ring(x, y, h, room, out, count):  # type: ignore[no-untyped-def]
    """Return the path from the last track to the nearest border of the room."""
    best, px, py, ph = np.inf, x, y, h
    for side in range(4):
        ah = side * math.pi / 2
        ax = room.x_to if side == 0 else room.x_from if side == 2 else x
        ay = room.y_to if side == 1 else room.y_from if side == 3 else y
        away = math.hypot(ax - x, ay - y)
        if away < best:
            best, px, py, ph = away, ax, ay, ah
    count = _join(x, y, h, px, py, ph, room, out, count)
    out[count, 0], out[count, 1] = px, py
    return count + 1
