"""thumbnail.png: what the light is to paint, so small that a list of jobs shows dozens of them at once."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from optics.heightfield import Array
from service.figures import srgb_levels

MOST_BYTES = 18_000
SIDES = (192, 168, 144, 120)  # pixels of the longer side; the last one fits even if nothing of it can be packed


def thumbnail_png(picture: Array, *, white: float) -> bytes:
    """8 bit grey, as `figures.picture_png` with the same exposure; averages of light, and never enlarged.

    picture : (ny, nx) linear irradiance as the viewer sees it, row 0 on top
    """
    packed = b""
    for side in SIDES:
        packed = _packed(_smaller(picture, side), white)
        if len(packed) <= MOST_BYTES:
            break
    return packed


def _smaller(picture: Array, side: int) -> Array:
    scale = side / max(picture.shape)
    if scale >= 1.0:
        return picture
    ny, nx = (max(1, round(scale * length)) for length in picture.shape)
    light = Image.fromarray(picture.astype(np.float32)).resize((nx, ny), Image.Resampling.BOX)
    return np.asarray(light, dtype=np.float64)


def _packed(picture: Array, white: float) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(srgb_levels(picture, white=white)).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
