"""The light of a piece with one finished half: each half is computed separately and added on one screen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.fft import next_fast_len

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.coupon.fringes import Transfer
from optics.coupon.layout import HALF_MM, HEIGHT_MM, WIDTH_MM, Half
from optics.heightfield import Array, Heightfield
from optics.milled import simulate_milled

AROUND_MM = 4.0
"""How far the screen reaches beyond the piece on all sides: its darkness there shows the level of black."""

_PAD_MM = 6.0


def screen_bench(throw_mm: float, refractive_index: float, half: Half) -> Bench:
    """Return one half by itself, its lower left corner the origin, before the screen of the whole piece."""
    return Bench.centre_on(
        width_mm=HALF_MM,
        height_mm=HEIGHT_MM,
        throw_mm=throw_mm,
        refractive_index=refractive_index,
        screen_mm=(WIDTH_MM + 2 * AROUND_MM, HEIGHT_MM + 2 * AROUND_MM),
        shift_mm=(HALF_MM / 2 if half == "left" else -HALF_MM / 2, 0.0),
    )


def screen_axes_mm(pixels: tuple[int, int]) -> tuple[Array, Array]:
    """Return work-frame x (nx,) and y (ny,) of the screen's pixels (ny, nx)."""
    ny, nx = pixels
    wide, high = WIDTH_MM + 2 * AROUND_MM, HEIGHT_MM + 2 * AROUND_MM
    return (np.arange(nx) + 0.5) * wide / nx - AROUND_MM, (np.arange(ny) + 0.5) * high / ny - AROUND_MM


def finish_heights(z_mm: Array, spacing_mm: float, transfer: Transfer) -> Array:
    """Return heights (ny, nx) after a finish of the whole surface, which is continued at its rims' height."""
    pad = round(_PAD_MM / spacing_mm)
    ny, nx = z_mm.shape
    # Extended on two sides to sizes without large prime factors: others take twice as long.
    wide = np.pad(z_mm, [(pad, next_fast_len(n + 2 * pad, real=True) - n - pad) for n in (ny, nx)], mode="edge")
    level = float(wide.mean())
    ky = 2 * np.pi * np.fft.fftfreq(wide.shape[0], spacing_mm)
    kx = 2 * np.pi * np.fft.rfftfreq(wide.shape[1], spacing_mm)
    left = np.fft.irfft2(np.fft.rfft2(wide - level) * transfer(np.hypot(kx, ky[:, None])), s=wide.shape)
    return np.asarray(left[pad : pad + ny, pad : pad + nx] + level)


def light_of_heights(
    x_mm: Array, y_mm: Array, z_mm: Array, half: Half, *, throw_mm: float, refractive_index: float,
    pixels: tuple[int, int],
) -> Array:  # fmt: skip
    """Return the irradiance (ny, nx) of one half, from heights on a grid that reaches beyond it; 1 is light that goes
    straight.
    """
    begin = 0.0 if half == "left" else HALF_MM
    columns = (x_mm >= begin - 1e-6) & (x_mm <= begin + HALF_MM + 1e-6)
    rows = (y_mm >= -1e-6) & (y_mm <= HEIGHT_MM + 1e-6)
    lens = Heightfield.on_aperture(z_mm[np.ix_(rows, columns)], width_mm=HALF_MM, height_mm=HEIGHT_MM)
    bench = screen_bench(throw_mm, refractive_index, half)
    seen = simulate_caustic(lens, bench, pixels=pixels, tubes_per_cell=1)
    return seen.irradiance / _straight(pixels)


def light_of_facets(
    part: Callable[[int], Array], parts: int, half: Half, *, throw_mm: float, refractive_index: float,
    pixels: tuple[int, int], on_progress: Callable[[float], None] | None = None,
) -> Array:  # fmt: skip
    """Return the irradiance (ny, nx) of one half, from facets (n, 4, 5) of the whole piece; 1 is light that goes
    straight.
    """
    begin = 0.0 if half == "left" else HALF_MM

    def of_half(number: int) -> Array:
        facets = part(number)
        facets = facets[((facets[:, :, 0] > begin - 0.5) & (facets[:, :, 0] < begin + HALF_MM + 0.5)).any(axis=1)]
        facets[:, :, 0] -= begin
        return facets

    flat = Heightfield.on_aperture(np.zeros((4, 4)), width_mm=HALF_MM, height_mm=HEIGHT_MM)
    bench = screen_bench(throw_mm, refractive_index, half)
    seen = simulate_milled(of_half, parts, flat, bench, pixels=pixels, on_progress=on_progress)
    return seen.irradiance / _straight(pixels)


def _straight(pixels: tuple[int, int]) -> float:
    """Return the irradiance of straight light through one half, in units of that half's light over the number of
    pixels.
    """
    bench = screen_bench(1.0, 1.5, "left")
    return bench.screen.width_mm * bench.screen.height_mm / (HALF_MM * HEIGHT_MM)
