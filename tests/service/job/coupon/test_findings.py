"""What photographs of a test piece say: taken from aside, too bright, too dark, or of something else."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from optics.coupon.layout import HEIGHT_MM
from optics.finish import Finish
from optics.irradiance import picture_from_irradiance
from optics.spline import Array
from service.job.coupon.findings import (
    SENTENCES,
    CouponFinding,
    CouponResult,
    measure_photo,
    print_findings,
    snippet,
)
from service.job.coupon.photograph import Photo
from service.job.coupon.piece import coupon_job, coupon_of
from service.job.coupon.programs import TEMPLATES_RAD_PER_MM, PredictedPiece
from service.job.photo.findings import UselessPhotoError
from service.job.spec.loading import resolve_spec
from service.job.spec.resolve import ResolvedJob
from tests.optics.coupon.pieces import smooth_piece
from tests.optics.photographs import camera, photographed

SHAPE = (900, 1350)
STRAIGHT = 0.18  # of white: what a meter makes of light that goes straight
TEMPLATE_PIXELS = (280, 480)


@cache
def job() -> ResolvedJob:
    """Of a mill whose ripples are those of the smooth piece."""
    return coupon_job(machine=None, throw_mm=None, file=None, overrides=["machine.step_mm=0.002"])


@cache
def predicted() -> PredictedPiece:
    piece = smooth_piece()
    finishes = [Finish(k0_rad_per_mm=k0, order=2.0) for k0 in TEMPLATES_RAD_PER_MM]
    right = piece.light("right", None, pixels=TEMPLATE_PIXELS)
    templates = tuple(piece.light("left", one, pixels=TEMPLATE_PIXELS) + right for one in finishes)
    y = np.linspace(-4.0, HEIGHT_MM + 4.0, 50)
    return PredictedPiece(profiles=piece.profiles, templates=templates, across=np.array([y, np.ones(50)]))


@cache
def light(k0: float, order: float, throw_mm: float = 20.4) -> Array:
    piece = smooth_piece()
    left = piece.light("left", Finish(k0_rad_per_mm=k0, order=order), throw_mm=throw_mm)
    return picture_from_irradiance(left + piece.light("right", None, throw_mm=throw_mm), viewed_from="behind")


def photo(seen: Array, *, aside_deg: float = 0.0, turns: int = 0, stops: float = 0.0, blur_px: float = 1.0) -> Photo:
    """stops: of exposure, from one that shows straight light as a meter wants it."""
    place = camera(aside_deg=aside_deg, roll_deg=2.0, quarter_turns=turns, aspect=48 / 28, shape=SHAPE, filling=0.8)
    metered = np.log2(STRAIGHT * np.quantile(seen, 0.99) / 0.8)
    shot = photographed(seen, place, shape=SHAPE, stops=stops + metered, blur_px=blur_px, background=0.003)
    return Photo(light=shot.photo, clipped=shot.photo >= 0.96)


def measured(shot: Photo) -> CouponResult:
    return measure_photo("wall.jpg", shot, predicted(), job())


def test_the_spec_of_the_tests_is_that_of_the_smooth_piece() -> None:
    """Or every other test here compares two different pieces."""
    assert coupon_of(job()) == smooth_piece().coupon


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("k0", "order", "shot"),
    [
        (6.0, 2.0, {"aside_deg": 30.0, "turns": 1, "stops": -2.0}),
        (3.0, 4.0, {"aside_deg": -30.0, "turns": 3, "stops": 2.0}),
        (20.0, 1.0, {"stops": 1.0}),
    ],
)
def test_k0_is_found_from_aside_whatever_the_exposure(
    k0: float, order: float, shot: dict[str, float], tmp_path: Path
) -> None:
    """Within 15 %, with the wall 2 % too far; what is written for the spec is accepted by it."""
    result = measured(photo(light(k0, order), **shot))  # type: ignore[arg-type]
    assert result.fit.k0_rad_per_mm == pytest.approx(k0, rel=0.15)
    assert result.finished == "left"
    assert result.placed.registration.confidence > 0.9
    assert len(list(print_findings(result))) >= 4 + len(result.fit.ripples)
    report = result.report()
    assert report["finish"]["k0_rad_per_mm"] == result.fit.k0_rad_per_mm
    file = tmp_path / "job.toml"
    file.write_text(snippet(result), encoding="utf-8")
    resolved = resolve_spec(file=file)
    assert resolved.finish.k0_rad_per_mm == pytest.approx(result.fit.k0_rad_per_mm, rel=0.01)
    assert resolved.finish.order == pytest.approx(result.fit.order, rel=0.05)
    assert resolved.machine.z_noise_mm == pytest.approx(result.rows.z_noise_mm, rel=0.1)


def rings() -> Array:
    """Something else in the light."""
    row, column = np.mgrid[0:560, 0:960]
    away = np.hypot(row - 280, column - 480)
    return np.asarray((away < 220) * (1.0 + np.cos(away / 9.0)))


SPOILT: dict[str, Callable[[], Photo]] = {
    "clipped": lambda: photo(light(6.0, 2.0), stops=3.5),
    "too_dark": lambda: photo(light(6.0, 2.0), stops=-5.0),
    "blurred": lambda: photo(light(6.0, 2.0), blur_px=12.0),
    "not_a_coupon": lambda: photo(rings()),
    "not_finished": lambda: photo(light(2000.0, 1.0)),
}
THOROUGH = ("blurred", "not_a_coupon", "not_finished")


@pytest.mark.parametrize(
    "code", [pytest.param(code, marks=[pytest.mark.thorough] * (code in THOROUGH)) for code in SPOILT]
)
def test_a_photograph_that_says_nothing_is_refused_with_the_reason(code: str) -> None:
    """One line names the file, what is wrong, and what would be right."""
    with pytest.raises(UselessPhotoError) as refused:
        measured(SPOILT[code]())
    assert refused.value.finding.code == code
    assert str(refused.value).startswith("wall.jpg: ")
    assert "allowed: " in str(refused.value)


def test_every_sentence_can_be_said() -> None:
    """The values that a sentence names are known ones of its finding."""
    names = "across blur_mm confidence count least level misfit most most_mm nominal_mm off_mm pixels_per_mm ripples"
    values = dict.fromkeys((*names.split(), "share", "throw_mm"), 1.0)
    for code in SENTENCES:
        said = CouponFinding(code, values).sentence()
        assert "{" not in said
        assert not said[0].isupper()
