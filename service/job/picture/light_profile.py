"""A measured picture of the light on the aperture as the rows of `optics.light.profile`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.errors import PictureError
from service.job.picture.decoding import decode_picture
from service.job.picture.limits import OWN_PICTURE
from service.job.picture.reading import resample_picture
from service.job.picture.resampling import Span, weights_to_resample

_MOST_NODES = 64  # along a side: the light of a lamp is smooth, and a spec stays readable


def light_rows(path: Path, *, tone: str) -> list[list[float]]:
    """Return the relative strength, brightest 1, top row first, on points from rim to rim.

    Each value is the mean over the box around its point, so that noise and dust are averaged away; at the rims it is
    half a box. The picture shows exactly the aperture.
    """
    image = decode_picture(path, OWN_PICTURE, str(path))
    (columns, across), (rows, down) = (_points(size) for size in image.size)
    covered = [
        np.asarray(weights_to_resample(size, span, count).sum(axis=1)).ravel()
        for size, span, count in ((image.size[0], across, columns), (image.size[1], down, rows))
    ]
    light = resample_picture(image, (rows, columns), across, down, tone=tone) / (
        covered[1][:, None] * covered[0][None, :]
    )
    if not light.max() > 0:
        raise PictureError(f"{path}: the picture of the light is black everywhere")
    return [[round(float(value), 4) for value in row] for row in light / light.max()]


def _points(size: int) -> tuple[int, Span]:
    """Return how many points stand along an axis of that many pixels, and the span of the boxes around them."""
    count = min(size, _MOST_NODES)
    half = size / (count - 1) / 2
    return count, Span(-half, size + half)
