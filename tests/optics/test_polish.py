"""Polish: the gradient is that of the picture's error, and the descent betters the picture and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Heightfield
from optics.irradiance import target_irradiance
from optics.light import Light
from optics.metrics import score_caustic
from optics.settings import LensSettings
from optics.spline import _fit_columns
from optics.tubes.picture import TubePicture
from optics.tubes.rays import fit_transposed

BENCH = Bench.centred(
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
    coefs = _fit_columns(np.ascontiguousarray(_fit_columns(z).T)).T
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
    """Same tubes, same light; where strength is uneven, a tube's two halves share it evenly: 1 % at the most."""
    lens, bench = wavy_lens(), replace(BENCH, **LIGHTS[light])
    ours = TubePicture(lens, bench, pixels=(14, 17), tubes_per_cell=2, beams=3).picture(lens.z_mm)
    theirs = simulate_caustic(lens, bench, pixels=(14, 17), tubes_per_cell=2, beams=3).irradiance
    even = "light" not in LIGHTS[light]
    np.testing.assert_allclose(ours, theirs, atol=1e-9 if even else 0.01 * theirs.max())


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
