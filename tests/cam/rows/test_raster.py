"""Rows cover the aperture at the pitch asked for; turns stay on the surface and inside the run-out."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.passes import Stock, ball_pass
from cam.rows import raster
from cam.rows.raster import Rows, continuous_rows, separate_rows
from cam.rows.vertices import finish_rule
from cam.surface.tool_surface import ToolSurface
from tests.cam.lenses import make_bumps

STOCK = Stock(width_mm=8, height_mm=6, thickness_mm=10, margin_mm=5)


def spec(radius_mm: float = 0.5, pitch_mm: float = 0.15):
    return ball_pass("p", radius_mm=radius_mm, pitch_mm=pitch_mm, stock_to_leave_mm=0, step_down_mm=1)


@given(height_mm=st.floats(2, 200), pitch_mm=st.floats(0.01, 0.5), radius_mm=st.sampled_from([0.5, 3.0]))
def test_rows_are_never_farther_apart_than_the_pitch(height_mm, pitch_mm, radius_mm):
    stock = Stock(width_mm=8, height_mm=height_mm, thickness_mm=10, margin_mm=5)
    y = Rows.over(stock, spec(radius_mm, pitch_mm)).y_mm
    assert y[0] == -radius_mm
    assert y[-1] == pytest.approx(height_mm + radius_mm, abs=5e-5)
    assert np.diff(y).max() <= pitch_mm + 1e-9
    assert np.diff(y).min() > 0
    assert y.size <= (height_mm + 2 * radius_mm) / (pitch_mm - 1e-4) + 2


def test_paper_finish_has_its_5000_rows_on_the_lens():
    stock = Stock(width_mm=100, height_mm=100, thickness_mm=40, margin_mm=5)
    y = Rows.over(stock, spec(0.5, 0.02)).y_mm
    assert ((y >= 0) & (y <= 100)).sum() == 5001


def test_one_unbroken_path_over_every_row():
    """There and back, exactly on the surface, turns included, never outside the aperture grown by one radius."""
    surface = ToolSurface.over(make_bumps(1, relief_mm=1.5), radius_mm=0.5)
    rows = Rows.over(STOCK, spec())
    path = np.concatenate(list(continuous_rows(surface, rows, finish_rule(1e-3, 0.1))))
    np.testing.assert_allclose(path[:, 2], surface.tip_heights_mm(path[:, 0], path[:, 1]), atol=1e-9)
    low, high = path.min(axis=0), path.max(axis=0)
    np.testing.assert_allclose(low[:2], (-0.5, -0.5), atol=1e-9)
    np.testing.assert_allclose(high[:2], (8.5, 6.5), atol=1e-9)
    jumps = np.diff(path, axis=0)
    assert np.hypot(jumps[:, 0], jumps[:, 1]).max() <= 1.0 + 1e-9
    for number, y in enumerate(rows.y_mm):
        x = path[path[:, 1] == y, 0]
        assert x.min() == rows.left_mm
        assert x.max() == rows.right_mm
        assert (np.sign(np.diff(x)) == (1 if number % 2 == 0 else -1)).all()
    assert path[-1, 1] == rows.y_mm[-1]


@pytest.mark.parametrize("count", [1, 3, 1000])
def test_the_path_does_not_depend_on_how_the_work_is_split(monkeypatch, count):
    surface = ToolSurface.over(make_bumps(2, relief_mm=1.0), radius_mm=0.5)
    rows = Rows.over(STOCK, spec(pitch_mm=0.25))
    rule = finish_rule(1e-3, 0.1)
    whole = np.concatenate(list(continuous_rows(surface, rows, rule)))
    monkeypatch.setattr(raster, "ROWS_PER_CHUNK", count)
    monkeypatch.setattr(raster, "THREADS", 1)
    np.testing.assert_array_equal(np.concatenate(list(continuous_rows(surface, rows, rule))), whole)


@pytest.mark.parametrize("rightward", [True, False])
def test_separate_rows_all_run_the_same_way(rightward):
    surface = ToolSurface.over(make_bumps(2, relief_mm=1.0), radius_mm=0.5)
    rows = Rows.over(STOCK, spec(pitch_mm=0.25))
    pieces = list(separate_rows(surface, rows, finish_rule(1e-3, 0.1), rightward=rightward))
    assert [p[0, 1] for p in pieces] == rows.y_mm.tolist()
    assert all(((np.diff(p[:, 0]) > 0) == rightward).all() for p in pieces)


def test_leaving_off_early_ends_the_workers():
    """An abandoned program leaves no thread behind."""
    surface = ToolSurface.over(make_bumps(2, relief_mm=1.0), radius_mm=0.5)
    pieces = continuous_rows(surface, Rows.over(STOCK, spec(pitch_mm=0.01)), finish_rule(1e-3, 0.1))
    next(pieces)
    pieces.close()
    assert not [t for t in threading.enumerate() if t.name.startswith(raster.THREAD_NAME)]
