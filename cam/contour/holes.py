"""Fill the holes that level lines leave, over summits, saddles and slivers, with short straight tracks."""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from cam.contour.cover import BLOCK, PIXELS_PER_PITCH, find_uncovered, pixels_over
from cam.contour.field import REACH_PITCHES, ContourField
from cam.contour.tracer import ContourLines
from cam.moves import Array
from cam.rows.raster import on_ticks

TILE_PITCHES = 40.0
"""Longer holes are filled piece by piece: they bend."""


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
    count = ceil(wide / (2 * 0.97 * REACH_PITCHES * pitch_mm))
    height = wide / count
    row = np.clip(((v - low_v) / height).astype(int), 0, count - 1)
    ends = []
    for k in np.unique(row):
        low, high = u[row == k].min() - edge, u[row == k].max() + edge
        middle, half = (low + high) / 2, max((high - low) / 2, pitch_mm / 4)
        across = low_v + (k + 0.5) * height
        ends += [centre + axes @ (across, middle - half), centre + axes @ (across, middle + half)]
    return np.array(ends)
