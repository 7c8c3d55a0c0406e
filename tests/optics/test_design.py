"""What a design says of itself: closing, creases, passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cam.surface.stock_touch import largest_fitting_radius_mm
from optics.design import design_lens
from optics.irradiance import target_irradiance
from optics.lens_settings import LensSettings


def test_closing_cost_is_stated_where_valleys_are_filled(settings: LensSettings) -> None:
    """A bright disc on black needs a tight valley around it, so a 4 mm ball costs decibels and leaks light."""
    y, x = np.mgrid[0:48, 0:48] - 23.5
    target = target_irradiance((np.hypot(x, y) < 10).astype(float), viewed_from="lens")
    design = design_lens(target, replace(settings, corrections=1, min_radius_mm=4.0))
    cost = design.closing
    assert cost is not None and cost.radius_mm == 4.0
    assert cost.psnr_db_with < cost.psnr_db_without
    assert cost.dark_leak_with > cost.dark_leak_without
    assert "4 mm" in " ".join(map(str, design.warnings))


def test_creases_close_nothing_on_a_finer_grid(settings: LensSettings, soft_picture: np.ndarray) -> None:
    target = target_irradiance(soft_picture, viewed_from="lens")
    design = design_lens(target, replace(settings, corrections=0, min_radius_mm=2.0, creases=True))
    assert design.closing is None
    assert design.heightfield.z_mm.shape == (4 * 48 + 1, 4 * 48 + 1)


def test_the_ball_fits_the_papers_lens_too(settings: LensSettings) -> None:
    """Its surface knows no cutter: what is too tight for one is opened afterwards."""
    bare = replace(settings, method="paper")
    picture = np.ones((24, 24))
    picture[6:18, 11:13] = 0.1
    target = target_irradiance(picture, viewed_from="lens")
    tightest_mm = largest_fitting_radius_mm(design_lens(target, bare).heightfield).everywhere_mm
    asked = replace(bare, min_radius_mm=2.0 * tightest_mm)
    assert largest_fitting_radius_mm(design_lens(target, asked).heightfield).everywhere_mm >= asked.min_radius_mm
