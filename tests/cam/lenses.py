"""Small lenses, and a slow and simple mill: numpy only, shares nothing with the code under test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optics.heightfield import Heightfield

Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]


def make_lens(z: Surface, *, width_mm: float = 8.0, height_mm: float = 6.0, per_mm: int = 10) -> Heightfield:
    """The function z(x, y) on a vertex grid over an aperture."""
    x = np.linspace(0, width_mm, round(width_mm * per_mm) + 1)
    y = np.linspace(0, height_mm, round(height_mm * per_mm) + 1)
    return Heightfield(x_mm=x, y_mm=y, z_mm=z(x[None, :], y[:, None]) + 0 * x[None, :] * y[:, None])


def make_bumps(seed: int, *, relief_mm: float, width_mm: float = 8.0, height_mm: float = 6.0, spread_mm: float = 1.5):
    """A smooth random lens whose highest vertex is 0.1 mm below the top of the stock."""
    rng = np.random.default_rng(seed)

    def z(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        total = np.zeros(np.broadcast(x, y).shape)
        for _ in range(12):
            cx, cy, a, s = *rng.uniform((0, 0), (width_mm, height_mm)), rng.uniform(-1, 1), spread_mm
            s *= rng.uniform(0.8, 1.6)
            total += a * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s))
        total -= total.min()
        return total * relief_mm / total.max() - relief_mm - 0.1

    return make_lens(z, width_mm=width_mm, height_mm=height_mm)


def brute_force(spline, cx: float, cy: float, radius_mm: float, samples: int = 401) -> float:
    """Centre height of a ball lowered onto the surface, by brute force over the footprint: never too high."""
    u = np.linspace(-1, 1, samples) * radius_mm * 0.9999
    dx, dy = np.meshgrid(u, u)
    inside = dx**2 + dy**2 < radius_mm**2
    f = spline.heights_mm(cx + dx[inside], cy + dy[inside]) + np.sqrt(radius_mm**2 - dx[inside] ** 2 - dy[inside] ** 2)
    return float(f.max())


@dataclass
class SlowMill:
    """A block of square cells that a ball eats into, move by move."""

    x_mm: np.ndarray
    y_mm: np.ndarray
    radius_mm: float
    top_mm: np.ndarray
    tip_mm: np.ndarray | None = None
    deepest_mm: float = 0.0  # most stock one feed move took
    deepest_plunge_mm: float = 0.0  # the same, straight down
    rapid_cut_mm: float = 0.0

    def move(self, to_mm: np.ndarray, *, rapid: bool) -> None:
        start = to_mm if self.tip_mm is None else self.tip_mm
        cell, r = self.x_mm[1] - self.x_mm[0], self.radius_mm
        lo, hi = np.minimum(start, to_mm) - r, np.maximum(start, to_mm) + r
        i = slice(*np.searchsorted(self.x_mm, (lo[0], hi[0])))
        j = slice(*np.searchsorted(self.y_mm, (lo[1], hi[1])))
        x, y, before = self.x_mm[i][None, :], self.y_mm[j][:, None], self.top_mm[j, i]
        self.tip_mm = np.array(to_mm)
        if not before.size:
            return
        after = before.copy()
        for t in np.linspace(0, 1, 2 + int(np.linalg.norm(to_mm - start) / cell)):
            tip = start + t * (to_mm - start)
            left = r * r - (x - tip[0]) ** 2 - (y - tip[1]) ** 2
            bottom = np.where(left > 0, tip[2] + r - np.sqrt(np.maximum(left, 0)), np.inf)
            after = np.minimum(after, bottom)
        taken = float((before - after).max())
        if rapid:
            self.rapid_cut_mm = max(self.rapid_cut_mm, taken)
            return
        self.deepest_mm = max(self.deepest_mm, taken)
        if np.array_equal(start[:2], to_mm[:2]):
            self.deepest_plunge_mm = max(self.deepest_plunge_mm, taken)
        self.top_mm[j, i] = after
