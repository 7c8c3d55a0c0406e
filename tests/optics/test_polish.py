"""Polish: the gradient is that of the picture's error, and the descent betters the picture and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cam.surface.stock_touch import largest_fitting_radius_mm
from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.corrections import correct_lens
from optics.design import design_lens
from optics.finish import Finish, finish_lens
from optics.heightfield import Heightfield
from optics.irradiance import target_irradiance
from optics.lens_settings import LensSettings
from optics.light import Light
from optics.metrics import score_caustic
from optics.polish import polish_lens
from optics.spline import _fit_all_columns
from optics.tubes.picture import TubePicture
from optics.tubes.rays import fit_transposed

BENCH = Bench.centre_on(
    width_mm=20.0,
    height_mm=16.0,
    throw_mm=40.0,
    refractive_index=1.49,
    screen_mm=(23.0, 20.0),
    shift_mm=(1.0, -2.0),
    thickness_mm=10.0,
)
LIGHTS = {
    "collimated": {},
    "sun": {"light": Light(kind="sun", size_deg=2.0)},
    "lamp": {"light": Light(kind="point", distance_mm=80.0, size_mm=2.0)},
    "uneven and tilted": {"light": Light(tilt_rad=(0.1, -0.05), profile=np.array([[1.0, 2.0], [3.0, 1.0]]))},
    "in an outline": {"outline_mm": np.array([[2.0, 1.0], [18.0, 3.0], [9.0, 15.5]])},
    "mirror": {"mirror": True},
    "mirror by a lamp": {"mirror": True, "light": Light(kind="point", distance_mm=100.0)},
}


def wavy_lens() -> Heightfield:
    y, x = np.mgrid[0:25, 0:31]
    z = 0.15 * np.sin(x / 5.0) * np.cos(y / 4.0) + 0.05 * np.sin(x * y / 40.0)
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=20.0, height_mm=16.0)


@pytest.mark.parametrize("nodes", [4, 5, 6, 9, 20])
def test_transposed_fit_is_the_transpose(nodes: int) -> None:
    """<F z, g> = <z, F^T g> for any z and g."""
    rng = np.random.default_rng(nodes)
    z, g = rng.random((nodes, nodes + 3)), rng.random((nodes + 2, nodes + 5))
    coefs = _fit_all_columns(np.ascontiguousarray(_fit_all_columns(z).T)).T
    assert (coefs * g).sum() == pytest.approx((z * fit_transposed(g)).sum(), rel=1e-12)


@pytest.mark.parametrize("light", LIGHTS)
def test_gradient_is_the_slope_of_the_error(light: str) -> None:
    """Central differences of 1e-6 mm, which the picture's kinks at pixel borders spoil by less than 1e-3."""
    lens, rng = wavy_lens(), np.random.default_rng(5)
    tubes = TubePicture(lens, replace(BENCH, **LIGHTS[light]), pixels=(14, 17), tubes_per_cell=2, beams=3)
    target, direction = rng.random((14, 17)), rng.standard_normal(lens.z_mm.shape)
    slope = float((tubes.gain(tubes.picture(lens.z_mm) - target) * direction).sum())
    errors = [0.5 * ((tubes.picture(lens.z_mm + s * direction) - target) ** 2).sum() for s in (1e-6, -1e-6)]
    assert (errors[0] - errors[1]) / 2e-6 == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("light", LIGHTS)
def test_picture_is_that_of_the_forward_model(light: str) -> None:
    """Same tubes, same light: to rounding."""
    lens, bench = wavy_lens(), replace(BENCH, **LIGHTS[light])
    ours = TubePicture(lens, bench, pixels=(14, 17), tubes_per_cell=2, beams=3).picture(lens.z_mm)
    theirs = simulate_caustic(lens, bench, pixels=(14, 17), tubes_per_cell=2, beams=3).irradiance
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_polish_betters_the_picture(settings: LensSettings, soft_picture: np.ndarray) -> None:
    """By finer tubes than it descended on, by micrometres only, with the top where it was."""
    target = target_irradiance(soft_picture, viewed_from="lens")
    plain = design_lens(target, replace(settings, corrections=1))
    design = design_lens(target, replace(settings, corrections=1, polish_steps=6))
    assert plain.polish is None
    assert design.polish is not None and design.polish.steps > 0

    def psnr(lens: Heightfield) -> float:
        light = simulate_caustic(lens, settings.bench, pixels=target.shape)
        return score_caustic(light.irradiance, target).psnr_db

    assert psnr(design.heightfield) > psnr(plain.heightfield) + 1.0
    assert design.polish.psnr_db_after > design.polish.psnr_db_before + 1.0
    assert design.heightfield.z_mm.max() == pytest.approx(-settings.skim_mm, abs=1e-12)
    assert 0.0 < design.polish.change_um_rms < 5.0


@pytest.mark.parametrize("ball_mm", [0.0, 2.0])
def test_polish_makes_no_fold_and_leaves_the_ball_its_room(
    settings: LensSettings, soft_picture: np.ndarray, ball_mm: float
) -> None:
    """Every tube's rays arrive in the order in which they left, before and after; its hollows stay as open as asked."""
    target = target_irradiance(soft_picture, viewed_from="lens")
    bench = settings.bench
    lens = design_lens(target, replace(settings, corrections=1, min_radius_mm=ball_mm)).heightfield
    done, record = polish_lens(lens, target, bench, steps=10, ball_mm=ball_mm)
    assert record.steps > 0
    for surface in (lens, done):
        assert turned_tubes(surface, bench, target.shape) == 0
        assert largest_fitting_radius_mm(surface).everywhere_mm >= ball_mm


@pytest.mark.parametrize("dark", [np.s_[:, :20], np.s_[:20], np.s_[40:, 50:]])
def test_polish_behind_a_finish_leaves_the_rims_as_smooth_as_the_rest(dark: tuple[slice, ...]) -> None:
    """Of a picture whose dark part runs out of it: vertices of a rim turn no more sharply than others, so the ball
    costs next to nothing there, the frame stays what it was, and the descent goes far.
    """
    picture = gaussian_filter(np.random.default_rng(7).random((64, 64)), 1.5) + 0.3
    picture[dark] *= 0.1
    target = picture / picture.mean()
    bench = Bench.centre_on(width_mm=25.0, height_mm=25.0, throw_mm=100.0, refractive_index=1.49)
    finish = Finish(k0_rad_per_mm=2.6, order=2.0, pad_mm=15.0, depth_mm=0.07)
    settings = LensSettings(bench=bench, skim_mm=0.1, min_radius_mm=3.0, finish=finish)
    start = correct_lens(target, settings).best.lens
    done, record = polish_lens(start, target, bench, steps=16, ball_mm=3.0, finish=finish)
    assert record.psnr_db_after > record.psnr_db_before + 1.0
    turns = [np.abs(np.diff(done.z_mm - start.z_mm, n=2, axis=axis)) for axis in (0, 1)]
    for inside, along in zip(turns, (turns[0], turns[1].T), strict=True):
        assert max(along[:3].max(), along[-3:].max()) < 2.0 * inside[8:-8, 8:-8].max()
    frame = np.ones(target.shape, dtype=np.bool_)
    frame[2:-2, 2:-2] = False
    before, after = (
        simulate_caustic(finish_lens(one, finish).lens, bench, pixels=target.shape).irradiance for one in (start, done)
    )
    assert np.square(after - target)[frame].mean() < 1.2 * np.square(before - target)[frame].mean()


def test_polish_of_a_hard_picture_ends_in_a_lens(settings: LensSettings) -> None:
    """Binary noise and two bright dots fold as it is: the descent stays finite and never makes the picture worse."""
    rng = np.random.default_rng(11)
    dots = np.full((32, 32), 1e-9)
    dots[8, 8] = dots[20, 25] = 1.0
    for picture in ((rng.random((32, 32)) > 0.5).astype(float), dots):
        target = picture / picture.mean()
        design = design_lens(target, replace(settings, corrections=1, min_radius_mm=0.5, polish_steps=5))
        assert np.isfinite(design.heightfield.z_mm).all()
        assert design.polish is not None and design.polish.psnr_db_after >= design.polish.psnr_db_before
        assert largest_fitting_radius_mm(design.heightfield).everywhere_mm >= 0.5


def turned_tubes(lens: Heightfield, bench: Bench, pixels: tuple[int, ...]) -> int:
    """How many quads of the lattice, two by two in each cell, arrive turned over."""
    tubes = TubePicture(lens, bench, pixels=(pixels[0], pixels[1]), tubes_per_cell=2, beams=1)
    tubes.picture(lens.z_mm)
    assert tubes.hits is not None
    x, y = tubes.hits
    across = (x[1:, 1:] - x[:-1, :-1]) * (y[1:, :-1] - y[:-1, 1:])
    return int((across - (x[1:, :-1] - x[:-1, 1:]) * (y[1:, 1:] - y[:-1, :-1]) <= 0.0).sum())
