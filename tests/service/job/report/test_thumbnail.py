"""thumbnail.png: the target, small in pixels and in bytes, in light as bright as the large one."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from service.job.picture.light_png import THUMBNAIL_BYTES, THUMBNAIL_SIDES, picture_png, srgb_levels, thumbnail_png
from service.job.picture.linear_light import srgb_to_linear


def opened(content: bytes) -> Image.Image:
    image = Image.open(io.BytesIO(content))
    assert image.mode == "L"
    return image


@settings(max_examples=30, deadline=None)
@given(ny=st.integers(1, 700), nx=st.integers(1, 700), seed=st.integers(0, 99))
def test_whatever_the_picture_it_is_small_and_keeps_its_shape(ny: int, nx: int, seed: int) -> None:
    """Noise is what packs worst."""
    content = thumbnail_png(np.random.default_rng(seed).random((ny, nx)), white=1.0)
    width, height = opened(content).size
    assert len(content) <= THUMBNAIL_BYTES
    assert max(width, height) == min(max(ny, nx), max(width, height)) and max(width, height) <= THUMBNAIL_SIDES[0]
    assert abs(width * ny - height * nx) <= 0.5 * max(nx, ny) + max(width, height)


@pytest.mark.parametrize("shape", [(64, 64), (192, 120)])
def test_a_small_picture_is_the_large_one_itself(shape: tuple[int, int]) -> None:
    light = np.linspace(0.0, 2.0, shape[0] * shape[1]).reshape(shape)
    assert thumbnail_png(light, white=1.5) == picture_png(light, white=1.5)


def test_a_pixel_is_the_mean_of_its_light() -> None:
    """Not of its grey levels: black and white stripes are half of the light, which is no mid grey."""
    light = np.tile([0.0, 1.0], (512, 256))
    grey = np.asarray(opened(thumbnail_png(light, white=1.0)), dtype=float)
    assert srgb_to_linear(grey / 255).mean() == pytest.approx(0.5, abs=0.01)
    ramp = np.add.outer(np.linspace(0, 1, 384), np.linspace(0, 3, 384))
    small = np.asarray(opened(thumbnail_png(ramp, white=4.0)), dtype=int)
    assert np.abs(small - srgb_levels(ramp.reshape(192, 2, 192, 2).mean((1, 3)), white=4.0).astype(int)).max() <= 1
