"""The finish from the fringes of both halves."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from optics.coupon.fit import FinishFit, fit_finish, misfit_as_milled
from optics.coupon.reading import Rectified, fold_all
from optics.finish import Finish
from optics.spline import Array
from tests.levels import mostly_thorough
from tests.optics.coupon.pieces import rectified, smooth_piece

THROW_MM = 20.4  # the wall stands 2 % too far
FINISHES = [(k0, order) for order in (1.0, 2.0, 4.0) for k0 in (3.0, 6.0, 12.0, 20.0)]


@cache
def as_milled() -> Array:
    return smooth_piece().light("right", None, throw_mm=THROW_MM)


def photograph(k0: float, order: float, *, white: float = np.inf) -> Rectified:
    left = smooth_piece().light("left", Finish(k0_rad_per_mm=k0, order=order), throw_mm=THROW_MM)
    return rectified(left, as_milled(), white=white)


def fitted(picture: Rectified) -> FinishFit:
    piece = smooth_piece()
    return fit_finish(piece.coupon, piece.profiles, fold_all(picture, piece.coupon), finished="left")


@pytest.mark.parametrize("finish", mostly_thorough(FINISHES, [(6.0, 2.0), (12.0, 1.0)]))
def test_the_finish_is_found(finish: tuple[float, float]) -> None:
    """k0 within 8 % and order within 15 %; half of the ripples lie within 0.05 of the truth; the wall is found."""
    k0, order = finish
    found = fitted(photograph(k0, order))
    assert found.k0_rad_per_mm == pytest.approx(k0, rel=0.08)
    assert found.order == pytest.approx(order, rel=0.15)
    assert found.throw_mm == pytest.approx(THROW_MM, abs=max(0.4, 2 * found.throw_error_mm))
    truth = Finish(k0_rad_per_mm=k0, order=order)
    misses = [abs(one.share - float(truth.transfer(np.array(one.k_rad_per_mm)))) for one in found.ripples]
    assert np.median(misses) < 0.05
    assert found.k0_range[0] <= found.k0_rad_per_mm <= found.k0_range[1]
    assert found.k0_range[1] / found.k0_range[0] < 1.4


def test_clipped_fringes_are_left_out() -> None:
    """Where everything above 1.4 times the straight light is white, k0 is still within 15 %."""
    assert fitted(photograph(6.0, 2.0, white=1.4)).k0_rad_per_mm == pytest.approx(6.0, rel=0.15)


def test_each_half_tells_whether_it_was_finished() -> None:
    """The misfit to what the programs mill is about 1 for a half as milled, and half as much again if finished."""
    piece = smooth_piece()
    folds = fold_all(photograph(12.0, 1.0), piece.coupon)
    assert misfit_as_milled(piece.coupon, piece.profiles, folds, "right") < 1.5
    assert misfit_as_milled(piece.coupon, piece.profiles, folds, "left") > 1.5
