"""Find the holes that level lines leave, over summits, saddles and slivers, and fill them with short straight tracks.

Theory of operation: places too far from every track are found on an exhaustive bitmap, strip by strip, one bit a pixel,
32 pixels to the pitch. Every segment of a track covers a capsule, the places within REACH_PITCHES of it; on a row of
pixels that is one interval, the hull of what its two discs and its slab cover. The distance to the nearest track
changes by no more than the distance between two places: a place farther than half a pitch + 1 % from all tracks has an
uncovered pixel within half a diagonal, 0.022 pitches. No hole that wide can hide between pixels. Bare pixels are
returned in blocks of 4 x 4.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from cam.contour.field import REACH_PITCHES, ContourField
from cam.contour.tracer import ContourLines
from cam.moves import Array
from cam.rows.raster import THREAD_NAME, THREADS, on_ticks

TILE_PITCHES = 40.0
"""Longer holes are filled piece by piece: they bend."""
PIXELS_PER_PITCH = 32
BLOCK = 4
STRIP_ROWS = 128
ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


def fill_holes(
    tracks: ContourLines, field: ContourField, *, width_mm: float, height_mm: float, pitch_mm: float
) -> ContourLines:
    """Return the tracks, and strokes over all places farther than half a pitch from them."""
    pixels = pixels_over(field, width_mm=width_mm, height_mm=height_mm, pitch_mm=pitch_mm)
    bare = find_uncovered(tracks, pixels, pitch_mm=pitch_mm)
    if not len(bare):
        return tracks
    strokes = make_strokes(bare, pitch_mm)
    ring_mm = field.ring_mm
    inside = np.clip(strokes.xy_mm, -ring_mm, (width_mm + ring_mm, height_mm + ring_mm))
    return ContourLines.join([tracks, replace(strokes, xy_mm=on_ticks(inside))])


def make_strokes(places_mm: Array, pitch_mm: float) -> ContourLines:
    """Lay rows over every cluster of the places (n, 2), along its long axis; each place is within the reach of one."""
    label = _clusters(places_mm, pitch_mm)
    order = np.argsort(label, kind="stable")
    bounds = np.flatnonzero(np.diff(label[order], prepend=-1))
    rows = [_rows(cluster, pitch_mm) for cluster in np.split(places_mm[order], bounds[1:])]
    xy = on_ticks(np.concatenate(rows))
    return ContourLines(xy_mm=xy, start=np.arange(0, len(xy) + 1, 2))


def _clusters(places_mm: Array, pitch_mm: float) -> np.ndarray:
    """Return (n,) labels: places in boxes of half a pitch that touch belong together, within one tile."""
    boxes, box = np.unique(np.floor(places_mm / (pitch_mm / 2)).astype(np.int64), axis=0, return_inverse=True)
    box = box.ravel()
    wide = int(np.ptp(boxes[:, 0])) + 3
    key = (boxes[:, 1] - boxes[:, 1].min()) * wide + boxes[:, 0] - boxes[:, 0].min()
    order = np.argsort(key)
    pairs = []
    for step in (1, wide - 1, wide, wide + 1):
        at = np.minimum(np.searchsorted(key[order], key + step), key.size - 1)
        met = key[order][at] == key + step
        pairs.append(np.stack([np.flatnonzero(met), order[at[met]]]))
    a, b = np.concatenate(pairs, axis=1)
    graph = sparse.coo_matrix((np.ones(a.size), (a, b)), shape=(key.size, key.size))
    blob = connected_components(graph, directed=False)[1]
    tile = np.floor(places_mm / (TILE_PITCHES * pitch_mm)).astype(np.int64)
    both = np.column_stack([blob[box], tile])
    return np.unique(both, axis=0, return_inverse=True)[1].ravel()


def _rows(places_mm: Array, pitch_mm: float) -> Array:
    """Return (2 n, 2) ends of straight rows that leave no place of a cluster farther than the reach."""
    centre = places_mm.mean(axis=0)
    away = places_mm - centre
    _, axes = np.linalg.eigh(away.T @ away)
    v, u = (away @ axes).T  # ascending eigenvalues: u runs along the long axis
    edge = pitch_mm * BLOCK / PIXELS_PER_PITCH / 2  # a place is the centre of a block
    low_v, wide = v.min() - edge, np.ptp(v) + 2 * edge
    count = math.ceil(wide / (2 * 0.97 * REACH_PITCHES * pitch_mm))
    height = wide / count
    row = np.clip(((v - low_v) / height).astype(int), 0, count - 1)
    ends = []
    for k in np.unique(row):
        low, high = u[row == k].min() - edge, u[row == k].max() + edge
        middle, half = (low + high) / 2, max((high - low) / 2, pitch_mm / 4)
        across = low_v + (k + 0.5) * height
        ends += [centre + axes @ (across, middle - half), centre + axes @ (across, middle + half)]
    return np.array(ends)


class Pixels(NamedTuple):
    """Centres at (x0 + i step, y0 + j step); those in the aperture (width, height) or in a wanted cell count."""

    x0: float
    y0: float
    step: float
    nx: int
    ny: int
    width: float
    height: float
    cells: Any
    cell_x0: float
    cell_y0: float
    cell_step: float


def pixels_over(field: ContourField, *, width_mm: float, height_mm: float, pitch_mm: float) -> Pixels:
    """Return all places that must be covered."""
    cells = field.wanted
    j, i = (np.flatnonzero(cells.any(axis)) for axis in (1, 0))
    step = pitch_mm / PIXELS_PER_PITCH
    x_from, y_from = field.x0_mm + i[0] * field.step_mm, field.y0_mm + j[0] * field.step_mm
    x_to = max(width_mm, field.x0_mm + (i[-1] + 1) * field.step_mm)
    y_to = max(height_mm, field.y0_mm + (j[-1] + 1) * field.step_mm)
    return Pixels(
        x0=x_from,
        y0=y_from,
        step=step,
        nx=64 * math.ceil(((x_to - x_from) / step + 1) / 64),
        ny=BLOCK * math.ceil(((y_to - y_from) / step + 1) / BLOCK),
        width=width_mm,
        height=height_mm,
        cells=cells,
        cell_x0=field.x0_mm,
        cell_y0=field.y0_mm,
        cell_step=field.step_mm,
    )


def find_uncovered(tracks: ContourLines, pixels: Pixels, *, pitch_mm: float) -> Array:
    """Return (n, 2) centres of all blocks that count and have a pixel farther from every track than the reach."""
    reach = REACH_PITCHES * pitch_mm
    strips = math.ceil(pixels.ny / STRIP_ROWS)
    at = np.zeros(strips + 1, np.int64)
    _sort_by_strip(tracks.xy_mm, tracks.start, pixels, reach, at, np.empty(0, np.int32), True)
    offset = np.concatenate([[0], np.cumsum(at)])
    listed = np.empty(offset[-1], np.int32)
    _sort_by_strip(tracks.xy_mm, tracks.start, pixels, reach, offset[:-1].copy(), listed, False)

    def strip(k: int) -> Array:
        rows = min(STRIP_ROWS, pixels.ny - k * STRIP_ROWS)
        covered = np.zeros((rows, pixels.nx // 64), np.uint64)
        _cover(tracks.xy_mm, listed[offset[k] : offset[k + 1]], pixels, reach, k * STRIP_ROWS, covered)
        out = np.empty((_bare(covered, pixels, k * STRIP_ROWS, np.empty((0, 2)), True), 2))
        _bare(covered, pixels, k * STRIP_ROWS, out, False)
        return out

    with ThreadPoolExecutor(THREADS, thread_name_prefix=THREAD_NAME) as pool:
        return np.concatenate(list(pool.map(strip, range(strips))))


@njit(cache=True, nogil=True)
def _sort_by_strip(xy, start, pixels, reach, at, listed, counting):  # type: ignore[no-untyped-def]
    """Count the segments that reach each strip in at, or list them from at[strip] on."""
    height = STRIP_ROWS * pixels.step
    last = (pixels.ny - 1) // STRIP_ROWS
    for track in range(start.size - 1):
        for k in range(start[track], start[track + 1] - 1):
            low = min(xy[k, 1], xy[k + 1, 1]) - reach - pixels.y0
            high = max(xy[k, 1], xy[k + 1, 1]) + reach - pixels.y0
            for s in range(max(0, int(math.floor(low / height))), min(last, int(math.floor(high / height))) + 1):
                if not counting:
                    listed[at[s]] = k
                at[s] += 1


@njit(cache=True, nogil=True, inline="always")
def _interval(ax, ay, ux, uy, length, reach, y):  # type: ignore[no-untyped-def]
    """Return (from, to) in x of the capsule around a + [0, length] u, at the ordinate y; from > to where there is
    none.
    """
    low, high = np.inf, -np.inf
    up = reach * reach - (y - ay) ** 2
    if up >= 0.0:
        half = math.sqrt(up)
        low, high = ax - half, ax + half
    up = reach * reach - (y - ay - length * uy) ** 2
    if up >= 0.0:
        half = math.sqrt(up)
        low, high = min(low, ax + length * ux - half), max(high, ax + length * ux + half)
    # slab: 0 <= (x - ax) ux + (y - ay) uy <= length and |(x - ax) uy - (y - ay) ux| <= reach
    a, b = -np.inf, np.inf
    along, across = (y - ay) * uy, (y - ay) * ux
    if abs(ux) > 1e-12:
        p, q = ax - along / ux, ax + (length - along) / ux
        a, b = min(p, q), max(p, q)
    elif along < 0.0 or along > length:
        return low, high
    if abs(uy) > 1e-12:
        p, q = ax + (across - reach) / uy, ax + (across + reach) / uy
        a, b = max(a, min(p, q)), min(b, max(p, q))
    elif abs(across) > reach:
        return low, high
    if a <= b:
        low, high = min(low, a), max(high, b)
    return low, high


@njit(cache=True, nogil=True)
def _cover(xy, segments, pixels, reach, j0, covered):  # type: ignore[no-untyped-def]
    """Set the bits, in covered (rows, words) from row j0 on, of all pixels that the segments cover."""
    rows = covered.shape[0]
    for k in segments:
        ax, ay = xy[k, 0], xy[k, 1]
        ux, uy = xy[k + 1, 0] - ax, xy[k + 1, 1] - ay
        length = math.hypot(ux, uy)
        if length > 0.0:
            ux, uy = ux / length, uy / length
        low, high = min(ay, xy[k + 1, 1]) - reach, max(ay, xy[k + 1, 1]) + reach
        first = max(0, int(math.ceil((low - pixels.y0) / pixels.step)) - j0)
        last = min(rows - 1, int(math.floor((high - pixels.y0) / pixels.step)) - j0)
        for j in range(first, last + 1):
            a, b = _interval(ax, ay, ux, uy, length, reach, pixels.y0 + (j0 + j) * pixels.step)
            if a > b:
                continue
            i_from = max(0, int(math.ceil((a - pixels.x0) / pixels.step)))
            i_to = min(pixels.nx - 1, int(math.floor((b - pixels.x0) / pixels.step)))
            if i_from > i_to:
                continue
            word, end = i_from >> 6, i_to >> 6
            head = ALL << np.uint64(i_from & 63)
            tail = ALL >> np.uint64(63 - (i_to & 63))
            if word == end:
                covered[j, word] |= head & tail
                continue
            covered[j, word] |= head
            for w in range(word + 1, end):
                covered[j, w] = ALL
            covered[j, end] |= tail


@njit(cache=True, nogil=True)
def _bare(covered, pixels, j0, out, counting):  # type: ignore[no-untyped-def]
    """Count the blocks that must be covered and have an unset bit, or write their centres to out (n, 2); return their
    number.
    """
    count = 0
    nibble = np.uint64(15)
    middle = (BLOCK - 1) / 2
    for j in range(0, covered.shape[0], BLOCK):
        for w in range(covered.shape[1]):
            bits = covered[j, w] & covered[j + 1, w] & covered[j + 2, w] & covered[j + 3, w]
            if bits == ALL:
                continue
            for n in range(0, 64, BLOCK):
                if (bits >> np.uint64(n)) & nibble == nibble:
                    continue
                x = pixels.x0 + (64 * w + n + middle) * pixels.step
                y = pixels.y0 + (j0 + j + middle) * pixels.step
                if _counts(pixels, x, y):
                    if not counting:
                        out[count, 0], out[count, 1] = x, y
                    count += 1
    return count


@njit(cache=True, nogil=True)
def _counts(pixels, x, y):  # type: ignore[no-untyped-def]
    """Return whether a block touches the aperture or lies in a wanted cell."""
    half = BLOCK / 2 * pixels.step
    if -half <= x <= pixels.width + half and -half <= y <= pixels.height + half:
        return True
    i = int(math.floor((x - pixels.cell_x0) / pixels.cell_step))
    j = int(math.floor((y - pixels.cell_y0) / pixels.cell_step))
    ny, nx = pixels.cells.shape
    return 0 <= i < nx and 0 <= j < ny and pixels.cells[j, i]
