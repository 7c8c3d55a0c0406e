"""Light on the wall as plain PNG files: full size, small for a list of jobs, or several side by side.

A picture here is (ny, nx) linear irradiance as the viewer sees it, row 0 at the top. All pictures of one job share one
exposure: white is the brightest pixel of the target, brighter light is clipped, so that files can be compared by eye.
Every function returns the bytes of a PNG and writes nothing.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from service.job.picture.linear_light import Array, linear_to_srgb
from service.job.picture.resampling import resize

COMPRESS_LEVEL = 3  # compression level, up to 9: a third of the time of the usual 6, files a tenth larger
THUMBNAIL_BYTES = 18_000
_ROW_SIDE = 300
THUMBNAIL_SIDES = (192, 168, 144, 120)  # pixels of the longer side; the last fits even if nothing can be packed


def srgb_levels(picture: Array, *, white: float) -> NDArray[np.uint8]:
    """Convert linear irradiance (any shape) to 8 bit sRGB; `white` becomes 255, brighter light is clipped.

    Raises ValueError unless white is positive and finite.
    """
    if not (np.isfinite(white) and white > 0):
        raise ValueError(f"white must be a positive irradiance, not {white}")
    linear = np.clip(np.nan_to_num(np.asarray(picture, dtype=np.float64)) / white, 0.0, 1.0)
    return np.asarray(np.rint(255.0 * linear_to_srgb(linear)), dtype=np.uint8)


def picture_png(picture: Array, *, white: float, side: int | None = None) -> bytes:
    """Draw the plain picture (ny, nx) as an 8 bit grey PNG.

    side : pixels along its longer side at most; a larger picture is shrunk, by averages of light
    """
    return _pack(srgb_levels(picture if side is None else _smaller(picture, side), white=white))


def row_png(pictures: Sequence[Array], *, white: float) -> bytes:
    """Draw pictures (ny, nx) of one shape side by side, small, with a white gap between them and no words."""
    levels = [srgb_levels(_smaller(picture, _ROW_SIDE), white=white) for picture in pictures]
    gap = np.full((levels[0].shape[0], _ROW_SIDE // 30), 255, dtype=np.uint8)
    return _pack(np.hstack([part for one in levels for part in (gap, one)][1:]))


def thumbnail_png(picture: Array, *, white: float) -> bytes:
    """Return `picture_png`, small: a list of jobs shows dozens.

    picture : (ny, nx) linear irradiance as the viewer sees it, row 0 on top
    """
    packed = b""
    for side in THUMBNAIL_SIDES:
        packed = picture_png(picture, white=white, side=side)
        if len(packed) <= THUMBNAIL_BYTES:
            break
    return packed


def _pack(levels: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(levels).save(buffer, format="PNG", compress_level=COMPRESS_LEVEL)
    return buffer.getvalue()


def _smaller(picture: Array, side: int) -> Array:
    scale = side / max(picture.shape)
    if scale >= 1.0:
        return picture
    ny, nx = (max(1, round(scale * length)) for length in picture.shape)
    return resize(picture, (ny, nx))
