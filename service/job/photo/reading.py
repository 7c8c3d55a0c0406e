"""A photograph's file as linear light, small enough to be compared with a prediction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from optics.spline import Array
from service.errors import PictureError
from service.job.picture.decoding import decode_picture, one_line
from service.job.picture.limits import OWN_PICTURE, PictureLimits
from service.job.picture.reading import resample_picture
from service.job.picture.resampling import Span

_LONGEST = 1600  # pixels: several for each one that a prediction is compared in
_CLIPPED_BYTE = 252  # of any channel: what the camera's colours hide, too
_DEEP = ("I", "F")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WallPhoto:
    """light (h, w): linear, 1 = the camera's white, row 0 on top; width, height: of the file [pixels]."""

    light: Array
    width: int
    height: int


def read_wall_photo(path: Path, *, limits: PictureLimits = OWN_PICTURE, name: str | None = None) -> WallPhoto:
    """Return the photograph at `path`, upright. PictureError, one line, which calls it by `name`, by default its path.

    Pixels in which one colour alone is clipped count as white: how much light there was is not known.
    """
    name = name or str(path)
    image = decode_picture(path, limits, name)
    width, height = image.size
    share = min(1.0, _LONGEST / max(width, height))
    shape = max(1, round(height * share)), max(1, round(width * share))
    try:
        light = resample_picture(image, shape, Span(0.0, float(width)), Span(0.0, float(height)), tone="srgb")
        if image.mode not in _DEEP and not image.mode.startswith("I;16"):
            light = np.where(_mask_clipped(image, shape), 1.0, light)
    except MemoryError:
        raise PictureError(f"{name}: {width} x {height} pixels do not fit in memory") from None
    except ValueError as error:  # a mode that Pillow cannot turn into RGB
        raise PictureError(f"{name}: cannot read its pixels ({one_line(error)})") from None
    return WallPhoto(light=light, width=width, height=height)


def _mask_clipped(image: Image.Image, shape: tuple[int, int]) -> Array:
    """Return where most of a pixel of that shape is clipped in some colour."""
    if image.mode not in ("L", "RGB"):
        image = image.convert("RGB")
    bright = None
    for channel in image.split():
        over = channel.point([255 if value >= _CLIPPED_BYTE else 0 for value in range(256)])
        smaller = np.asarray(over.resize((shape[1], shape[0]), Image.Resampling.BOX)) > 127
        bright = smaller if bright is None else bright | smaller
    return np.asarray(bright)
