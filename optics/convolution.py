"""Convolution of a picture by FFT, as scipy.signal.fftconvolve(mode="same"), whose import alone takes a second."""

from __future__ import annotations

import numpy as np
from scipy import fft

from optics.spline import Array


def convolve_same(picture: Array, kernel: Array) -> Array:
    """Return the middle of the full convolution, in the picture's shape; zero beyond the picture."""
    full = [a + b - 1 for a, b in zip(picture.shape, kernel.shape, strict=True)]
    fast = [fft.next_fast_len(n, real=True) for n in full]
    spectrum = fft.rfftn(picture, fast) * fft.rfftn(kernel, fast)
    (top, left), (ny, nx) = ((n - 1) // 2 for n in kernel.shape), picture.shape
    return np.asarray(fft.irfftn(spectrum, fast)[top : top + ny, left : left + nx])
