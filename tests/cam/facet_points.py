"""Facets of a milled surface as points with weights, so that what lies in a window can be told from what does not."""

from __future__ import annotations

import numpy as np


def areas(facets: np.ndarray) -> np.ndarray:
    """(n,) in plan."""
    x, y = facets[..., 0], facets[..., 1]
    return np.abs((x[:, 2] - x[:, 0]) * (y[:, 3] - y[:, 1]) - (x[:, 3] - x[:, 1]) * (y[:, 2] - y[:, 0])) / 2


def spread_over(facets, low, high, parts=40, *, beyond_mm=0.3):
    """(points (n, 5), weights): places, heights and slopes all over the facets, those within the window.

    beyond_mm : no facet is longer
    """
    middle = facets[:, :, :2].mean(axis=1)
    near = ((middle > low - np.full(2, beyond_mm)) & (middle < high + np.full(2, beyond_mm))).all(axis=1)
    rng, chosen, points = np.random.default_rng(7), facets[near], []
    for _ in range(parts):
        u, v = rng.random((2, len(chosen)))
        shares = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
        points.append(np.einsum("nkd,nk->nd", chosen, shares))
    found, weight = np.concatenate(points), np.tile(areas(chosen) / parts, parts)
    inside = ((found[:, :2] > low) & (found[:, :2] < high)).all(axis=1)
    return found[inside], weight[inside]


def rms(values: np.ndarray, weights: np.ndarray | None = None) -> float:
    return float(np.sqrt(np.average(values**2, weights=weights)))
