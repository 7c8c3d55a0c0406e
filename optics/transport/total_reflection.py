"""Is total reflection what stopped a design: how far light must turn at the surface, and the throw that eases it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from optics.bench import Bench
from optics.errors import TotalReflectionError
from optics.light import Light, meet
from optics.spline import Array

_SAFE = 0.6  # of the tangent of the greatest turn: relief and pixels' own slopes need the rest
_FARTHEST = 1e6  # throws that are tried, in screens


def move_far_away(bench: Bench) -> Bench:
    """Return the same frames under even light and so far apart that nothing is reflected: its map hardly differs."""
    s = bench.screen
    throw_mm = 20 * max(bench.width_mm, bench.height_mm, s.width_mm, s.height_mm, *map(abs, bench.shift_mm))
    return replace(bench, throw_mm=max(throw_mm, 20 * bench.throw_mm), light=Light(), mirror=False, outline_mm=None)


def refuse_wide_turns(lens_mm: Array, screen_mm: Array, bench: Bench) -> None:
    """Raise TotalReflectionError if light on its way from lens_mm to screen_mm (..., 2) turns too far for the index.

    Light leaves where n d . s > 1, so it turns by at most the angle whose tangent is sqrt(n^2 - 1). Mirrors may turn
    it as far as they like.
    """
    if bench.mirror:
        return
    p, q = lens_mm.reshape(-1, 2), screen_mm.reshape(-1, 2)
    beam = bench.beam()
    before = np.array([meet(beam, x, y, 0.0)[:3] for x, y in p])
    most = math.atan(_SAFE * math.sqrt(bench.refractive_index**2 - 1))

    def turn(throw_mm: float) -> float:
        way = np.concatenate([q - p, np.full((len(p), 1), throw_mm)], axis=1)
        cosine = (way * before).sum(axis=1) / np.linalg.norm(way, axis=1)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)).max())

    if turn(bench.throw_mm) <= most:
        return
    low, high = bench.throw_mm, _FARTHEST * max(bench.screen.width_mm, bench.screen.height_mm)
    enough = turn(high) <= most
    for _ in range(60 if enough else 0):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if turn(middle) <= most else (middle, high)
    raise TotalReflectionError(
        throw_mm=bench.throw_mm,
        shift_mm=float(np.linalg.norm(q - p, axis=1).max()),
        shortest_throw_mm=high if enough else math.inf,
    )
