"""Errors of rows from the grain of the light."""

from __future__ import annotations

import numpy as np
import pytest

from optics.coupon import grain
from optics.coupon.grain import RowErrors, fit_row_errors
from optics.spline import Array

RADIUS_MM, PITCH_MM, LEVER_MM, BLUR_MM = 1.0, 0.06, 9.8, 0.05


def errors_of(sigma_mm: float, monkeypatch: pytest.MonkeyPatch) -> RowErrors:
    """What is said of the light of pieces made with other random numbers."""
    monkeypatch.setattr(grain, "_SEED", 99)
    seen = float(np.median(grain._grain_of_rows(sigma_mm, RADIUS_MM, PITCH_MM, LEVER_MM, BLUR_MM)))
    monkeypatch.undo()
    return fit_row_errors(seen, radius_mm=RADIUS_MM, pitch_mm=PITCH_MM, lever_mm=LEVER_MM, blur_mm=BLUR_MM)


@pytest.mark.parametrize("sigma_mm", [0.0003, 0.0008])
def test_errors_smaller_than_the_cusps_are_found(sigma_mm: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 20 %, and inside the range that is stated."""
    found = errors_of(sigma_mm, monkeypatch)
    assert found.z_noise_mm == pytest.approx(sigma_mm, rel=0.2)
    assert found.low_mm < sigma_mm < found.high_mm


def test_errors_as_large_as_the_cusps_are_bounded_from_below_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cusps of 1.8 um are p^2 / 2R; of errors of 3 um only a lower bound is said."""
    found = errors_of(0.003, monkeypatch)
    assert found.high_mm == np.inf
    assert found.low_mm > 0.0006


def lowest(y_mm: Array, rows_mm: Array, z_mm: Array) -> Array:
    return np.asarray((z_mm + (y_mm[:, None] - rows_mm) ** 2 / (2 * RADIUS_MM)).min(axis=1))


def test_grooves_are_the_lowest_of_all_parabolas() -> None:
    """Between its borders each remaining row is nowhere above the lowest of all rows."""
    rng = np.random.default_rng(4)
    rows = PITCH_MM * np.arange(60)
    z = 0.002 * rng.standard_normal(60)
    y, begin, end = grain._grooves(rows, z, RADIUS_MM)
    assert 5 < y.size < 60
    np.testing.assert_allclose(begin[1:], end[:-1])
    at = begin + (end - begin) * 0.37
    own = z[np.searchsorted(rows, y - 1e-9)] + (at - y) ** 2 / (2 * RADIUS_MM)
    np.testing.assert_allclose(own, lowest(at, rows, z), atol=1e-12)
