"""Inverting a moved grid."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optics.transport_map import screen_positions


@given(seed=st.integers(0, 2**32 - 1), bend=st.floats(0.0, 0.45))
def test_bilinear_grid_is_inverted_exactly(seed: int, bend: float) -> None:
    """Put the found (u, v) back into the moved grid: the vertex comes out."""
    rng = np.random.default_rng(seed)
    px, py = np.meshgrid(np.arange(8.0), np.arange(6.0))
    px[1:-1, 1:-1] += bend * (2 * rng.random((4, 6)) - 1)
    py[1:-1, 1:-1] += bend * (2 * rng.random((4, 6)) - 1)
    x, y = np.linspace(0, 7, 29), np.linspace(0, 5, 23)
    u, v = screen_positions(px, py, x, y)
    i, j = np.minimum(u.astype(int), 6), np.minimum(v.astype(int), 4)
    f, g = u - i, v - j
    for grid, expected in ((px, x[None, :]), (py, y[:, None])):
        back = (
            grid[j, i] * (1 - f) * (1 - g)
            + grid[j, i + 1] * f * (1 - g)
            + grid[j + 1, i] * (1 - f) * g
            + grid[j + 1, i + 1] * f * g
        )
        np.testing.assert_allclose(back, np.broadcast_to(expected, back.shape), atol=1e-9)


def test_folds_leave_no_vertex_open() -> None:
    px, py = np.meshgrid(np.arange(6.0), np.arange(6.0))
    px[2, 2], px[2, 3] = 3.4, 2.2  # one quad turned over
    u, v = screen_positions(px, py, np.linspace(0, 5, 41), np.linspace(0, 5, 41))
    assert np.isfinite(u).all()
    assert np.isfinite(v).all()


def test_vertices_beyond_the_grid_take_their_neighbours() -> None:
    """A grid that is drawn in from one side: what it leaves open goes on with the values at its border."""
    px, py = np.meshgrid(0.6 * np.arange(6.0), np.arange(6.0))
    u, v = screen_positions(px, py, np.linspace(0, 5, 21), np.linspace(0, 5, 21))
    np.testing.assert_allclose(u[:, -4:], 5.0, atol=1e-9)
    np.testing.assert_allclose(v[10], 2.5, atol=0.3)
