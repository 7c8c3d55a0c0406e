"""Registers a photograph of the test piece's light with the piece."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from optics.coupon.halves import AROUND_MM, screen_axes_mm
from optics.coupon.layout import HALF_MM, HEIGHT_MM, WIDTH_MM
from optics.coupon.reading import Rectified
from optics.heightfield import Array
from optics.irradiance import ViewedFrom
from optics.photograph import Registration, register
from optics.photograph.homography import apply_homography
from phrases.phrase import Phrase
from service.errors import PictureError
from service.job.picture import OWN_PICTURE, PictureLimits
from service.job.picture.decoding import decode_picture, too_large_for_memory, unreadable
from service.job.picture.linear_light import ToneReader

PIXELS_PER_MM = 40
_CLIPPED = 0.94  # of white, in linear light; a camera's response is not linear above
_DARK = 2.0  # mm beyond the piece from which only the room's light is expected


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photo:
    """light (h, w): linear, 1 is the camera's white, row 0 on top; clipped (h, w): where any colour is."""

    light: Array
    clipped: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placed:
    """A photograph in its place.

    level         : level of undeflected light, in units of the camera's white
    pixels_per_mm : of the photograph, on the wall
    """

    registration: Registration
    picture: Rectified
    level: float
    pixels_per_mm: float


def _pixel_sizes_mm(u: Array, v: Array) -> tuple[float, float]:
    """Return the sizes along x, in the middle of either half, of a photograph whose pixel is (u, v) at each place (ny,
    nx).
    """
    row = u.shape[0] // 2
    sizes = []
    for x_mm in (HALF_MM / 2, 1.5 * HALF_MM):
        column = round((x_mm + AROUND_MM) * PIXELS_PER_MM)
        away = math.hypot(*(float(at[row, column + 1] - at[row, column]) for at in (u, v)))
        sizes.append(1 / (PIXELS_PER_MM * away) if away > 0 else 1 / PIXELS_PER_MM)
    return sizes[0], sizes[1]


def read_photo(path: Path, *, limits: PictureLimits = OWN_PICTURE, name: str | None = None) -> Photo:
    """Read a photograph from a file; PictureError if it cannot be read, which calls it by `name`, by default its
    path.
    """
    name = name or str(path)
    decoded = decode_picture(path, limits, name)
    image = decoded.image
    try:
        light = ToneReader.of(decoded, tone="srgb").read_strip(0, image.height)
        colours = np.asarray(image.convert("RGB"))
    except ValueError as error:
        raise unreadable(name, error) from None
    except MemoryError:
        raise too_large_for_memory(name, image.width, image.height) from None
    if not np.ptp(light) > 0:
        raise PictureError(Phrase("{name}: the photograph is the same everywhere: it shows no light", name=name))
    return Photo(light=light, clipped=colours.max(axis=2) >= 250)


def place_photo(photo: Photo, predicted: Array, *, viewed_from: ViewedFrom) -> Placed:
    """Return the photograph over the piece. ValueError if it shows no light.

    predicted (ny, nx) : light of the piece on its screen, work frame
    """
    found = register(photo.light, predicted, viewed_from=viewed_from)
    ny, nx = (round((side + 2 * AROUND_MM) * PIXELS_PER_MM) for side in (HEIGHT_MM, WIDTH_MM))
    x, y = screen_axes_mm((ny, nx))
    turned = -1.0 if viewed_from == "lens" else 1.0
    column = (0.5 + turned * ((np.arange(nx) + 0.5) / nx - 0.5)) * predicted.shape[1]
    row = (1.0 - (np.arange(ny) + 0.5) / ny) * predicted.shape[0]
    u, v = apply_homography(found.homography, *np.broadcast_arrays(column, row[:, None]))
    finer = found.pixels_per_pixel * predicted.shape[1] / nx  # pixels of the photograph in one of the rectified
    light = gaussian_filter(photo.light, 0.35 * finer) if finer > 1.3 else photo.light
    spoilt = maximum_filter(photo.clipped | (photo.light >= _CLIPPED), 3).astype(np.float64)
    high, wide = photo.light.shape
    inside = (u > 1) & (u < wide - 1) & (v > 1) & (v < high - 1)
    at = np.nan_to_num(np.stack([v - 0.5, u - 0.5]))
    seen = map_coordinates(light, at, order=1, mode="nearest")
    white = inside & (map_coordinates(spoilt, at, order=1, mode="nearest") >= 0.5)
    usable = inside & ~white
    around = np.maximum(np.maximum(-x, x - WIDTH_MM), np.maximum(-y, y - HEIGHT_MM)[:, None]) > _DARK
    black = float(np.median(seen[around & usable])) if (around & usable).any() else found.offset
    picture = Rectified(
        x_mm=x, y_mm=y, light=np.maximum(seen - black, 0.0), usable=usable, white=white, pixel_mm=_pixel_sizes_mm(u, v)
    )
    within = (x > 0) & (x < WIDTH_MM) & ((y > 0) & (y < HEIGHT_MM))[:, None]
    level = float(np.median(picture.light[within & inside])) if (within & inside).any() else 0.0
    return Placed(
        registration=found,
        picture=picture,
        level=level,
        pixels_per_mm=finer * PIXELS_PER_MM if math.isfinite(finer) else 0.0,
    )
