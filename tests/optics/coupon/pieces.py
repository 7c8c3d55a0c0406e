"""A test piece that an errorless mill has cut smoothly, and its light: what is quick enough for tests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter

from optics.coupon.fringes import Profile, profiles_of_heights
from optics.coupon.halves import finish_heights, light_of_heights, screen_axes_mm
from optics.coupon.layout import Coupon, Half
from optics.coupon.reading import Rectified
from optics.finish import Finish
from optics.spline import Array

SPACING_MM = 0.025
BEYOND = 36  # cells of the heights around the piece
PIXELS = (840, 1440)  # 30 a mm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Piece:
    """Heights (ny, nx) of the piece and around it, with the profiles that follow from them."""

    coupon: Coupon
    x_mm: Array
    y_mm: Array
    z_mm: Array
    profiles: tuple[Profile, ...]

    def light(
        self, half: Half, finish: Finish | None, *, throw_mm: float = 20.0, pixels: tuple[int, int] = PIXELS
    ) -> Array:
        """Irradiance (ny, nx) of one half on the screen of the whole; 1 goes straight."""
        z = self.z_mm if finish is None else finish_heights(self.z_mm, SPACING_MM, finish.transfer)
        index = self.coupon.refractive_index
        return light_of_heights(self.x_mm, self.y_mm, z, half, throw_mm=throw_mm, refractive_index=index, pixels=pixels)


@cache
def smooth_piece() -> Piece:
    """The surface as designed, ripples as high as those of a mill with steps of 2 um."""
    coupon = Coupon(step_mm=0.002)
    lens = coupon.heightfield(SPACING_MM)
    z = np.pad(lens.z_mm, BEYOND, mode="edge")
    x, y = (SPACING_MM * np.arange(-BEYOND, n + BEYOND) for n in (lens.x_mm.size, lens.y_mm.size))
    return Piece(coupon=coupon, x_mm=x, y_mm=y, z_mm=z, profiles=profiles_of_heights(coupon, x, y, z))


def rectified(
    left: Array, right: Array, *, blur_mm: float = 0.05, noise: float = 0.02, white: float = np.inf
) -> Rectified:
    """A photograph in its place: blurred, noisy, and white where it was too bright."""
    x, y = screen_axes_mm(left.shape)
    light = gaussian_filter(left + right, blur_mm * left.shape[1] / 48.0)
    light = light * (1 + noise * np.random.default_rng(3).standard_normal(light.shape))
    return Rectified(
        x_mm=x,
        y_mm=y,
        light=np.minimum(light, white),
        usable=light < white,
        white=light >= white,
        pixel_mm=(0.03, 0.03),
    )
