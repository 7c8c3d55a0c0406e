"""Small pictures of what the light is to paint, and will paint: a list of jobs shows dozens of them at once."""

from __future__ import annotations

from optics.heightfield import Array
from service.job.picture.resampling import resize
from service.job.report.figures.wall import picture_png

MOST_BYTES = 18_000
SIDES = (192, 168, 144, 120)  # pixels of the longer side; the last one fits even if nothing of it can be packed


def thumbnail_png(picture: Array, *, white: float) -> bytes:
    """Return `figures.picture_png` with the same exposure; averages of light, and never enlarged.

    picture : (ny, nx) linear irradiance as the viewer sees it, row 0 on top
    """
    packed = b""
    for side in SIDES:
        packed = picture_png(_smaller(picture, side), white=white)
        if len(packed) <= MOST_BYTES:
            break
    return packed


def _smaller(picture: Array, side: int) -> Array:
    scale = side / max(picture.shape)
    if scale >= 1.0:
        return picture
    ny, nx = (max(1, round(scale * length)) for length in picture.shape)
    return resize(picture, (ny, nx))
