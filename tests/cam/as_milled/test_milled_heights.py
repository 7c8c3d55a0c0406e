"""Heights of a milled surface on a grid."""

from __future__ import annotations

import numpy as np

from cam.as_milled.surface import mill_heights
from cam.as_milled.tracks import Tracks
from cam.surface.stock_grid import StockGrid

RADIUS_MM = 0.8


def test_heights_are_the_lowest_ball_anywhere_on_the_tracks() -> None:
    """Against balls set down every 2 um along two chains of crooked chords; elsewhere the stock stays."""
    rng = np.random.default_rng(8)
    x = np.linspace(0.0, 1.2, 9)
    rows = [np.stack([x, np.full(9, y), -0.05 - 0.02 * rng.random(9)], axis=1) for y in (0.3, 0.42)]
    tips = np.concatenate(rows)
    joined = np.ones(18, dtype=np.bool_)
    joined[[0, 9]] = False
    before = StockGrid(x0_mm=0.0, y0_mm=0.0, cell_mm=0.04, top_mm=np.zeros((20, 30)))
    left = mill_heights([Tracks(radius_mm=RADIUS_MM, tips_mm=tips, joined=joined)], before)
    fine = np.concatenate(
        [np.stack([np.interp(np.linspace(0, 1.2, 601), x, row[:, d]) for d in range(3)], 1) for row in rows]
    )
    places = np.stack(np.meshgrid(left.x_mm, left.y_mm), axis=-1)
    away2 = ((places[:, :, None, :] - fine[:, :2]) ** 2).sum(axis=-1)
    balls = np.where(away2 < RADIUS_MM**2, fine[:, 2] + RADIUS_MM - np.sqrt(np.maximum(RADIUS_MM**2 - away2, 0.0)), 0.0)
    np.testing.assert_allclose(left.top_mm, np.minimum(balls.min(axis=2), 0.0), atol=2e-6)
    assert (left.top_mm[-1] == 0.0).any()
