"""Convolution of a picture by FFT."""

import numpy as np
import pytest

from optics.convolution import convolve_same


@pytest.mark.parametrize("kernel", [(1, 1), (3, 5), (9, 3)])
def test_it_is_scipys(kernel):
    from scipy.signal import fftconvolve  # slow to import

    rng = np.random.default_rng(1)
    picture, weights = rng.random((12, 17)), rng.random(kernel)
    assert np.allclose(convolve_same(picture, weights), fftconvolve(picture, weights, mode="same"), rtol=0, atol=1e-13)
