"""Reads picture files as linear light, row 0 on top: the picture in [0, 1] at the job's pixel count; a photograph of
the wall, reduced for comparison with a prediction; the measured light on the aperture.

Theory of operation: the header alone decides whether the picture is accepted; then it is decoded, turned by its
EXIF note, and read strip by strip into linear light, where pixels may be averaged. Resampling keeps averages: each
target pixel is the mean over the exact area it covers (Catmull-Rom only where the picture must be enlarged).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt
from PIL import Image

from phrases.phrase import Phrase
from service.errors import PictureError
from service.job.picture import OWN_PICTURE, PictureLimits
from service.job.picture.decoding import DecodedPicture, decode_picture, too_large_for_memory, unreadable
from service.job.picture.linear_light import ToneReader, has_alpha, invert_tones, is_deep
from service.job.picture.resampling import Span, weights_to_resample

Array = npt.NDArray[np.float64]

_STRIP_PIXELS = 4_000_000
_BLACK = 1e-7  # far below the first step of 16 bits, above rounding
_ONE_TONE = 1e-4  # relative spread of a picture of one tone: far below one 8 bit step
_PHOTO_PIXELS = 1600  # along the longer side: several for each pixel of the comparison
_CLIPPED_BYTE = 252  # value of any channel from which it counts as clipped
_MOST_NODES = 64  # along a side: the light of a lamp is smooth, and a spec stays readable


class Reading(Protocol):
    """How a picture is read; the spec's [image] is one. pixels counts along the screen's width."""

    @property
    def pixels(self) -> int: ...
    @property
    def tone(self) -> Literal["srgb", "linear"]: ...
    @property
    def fit(self) -> Literal["crop", "pad", "stretch"]: ...
    @property
    def invert(self) -> bool: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """linear (ny, nx) in [0, 1], row 0 on top; facts about the file; warnings for the person.

    warnings : sentences without their subject, the picture: the caller adds its name
    """

    linear: Array
    width: int
    height: int
    mode: str
    warnings: tuple[Phrase, ...]

    @property
    def is_one_tone(self) -> bool:
        return bool(np.ptp(self.linear) <= _ONE_TONE * self.linear.max())


def read_picture(
    path: Path,
    settings: Reading,
    *,
    rows: int,
    aspect: float,
    limits: PictureLimits = OWN_PICTURE,
    name: str | None = None,
) -> Picture:
    """Return the picture at `path` as (rows, settings.pixels) linear light for a screen of aspect = width / height.

    Transparent parts lie over white (mixed in linear light). `pad` adds black: light goes to the picture alone.
    `invert` is a negative in the picture's own tones. Raises PictureError, one line, and nothing else; it
    calls the picture by `name`, by default its path.
    """
    name = name or str(path)
    return picture_of(decode_picture(path, limits, name), settings, rows=rows, aspect=aspect, name=name)


def picture_of(decoded: DecodedPicture, settings: Reading, *, rows: int, aspect: float, name: str) -> Picture:
    """Make the same from a decoded picture; can be called again."""
    width, height = decoded.image.size
    across, down = _spans(width, height, settings.fit, aspect)
    try:
        tones = ToneReader.of(decoded, tone=settings.tone)
        linear = resample_picture(tones, (rows, settings.pixels), across, down, invert=settings.invert)
    except MemoryError:
        raise too_large_for_memory(name, width, height) from None
    except ValueError as error:  # a mode that Pillow cannot turn into RGB
        raise unreadable(name, error) from None
    if not linear.max() > _BLACK:
        if settings.invert:
            words = Phrase(
                "{name}: the picture is black everywhere after inversion, there is no light to aim", name=name
            )
        else:
            words = Phrase("{name}: the picture is black everywhere, there is no light to aim", name=name)
        raise PictureError(words)
    picture = Picture(linear=linear, width=width, height=height, mode=decoded.image.mode, warnings=tones.warnings)
    if linear.min() > 1.0 - _ONE_TONE and _has_clear_parts(decoded):
        words = Phrase(
            "{name}: clear parts count as white, and so the picture is white all over: put it on a dark background",
            name=name,
        )
        raise PictureError(words)
    return _with_warnings(picture, settings)


def _has_clear_parts(decoded: DecodedPicture) -> bool:
    image = decoded.image
    if is_deep(image):
        return "transparency" in image.info
    if not has_alpha(image):
        return False
    pixels = (image.convert("LA") if image.mode == "La" else image).convert("RGBA")
    return pixels.getchannel("A").getextrema()[0] != 255


def _with_warnings(picture: Picture, settings: Reading) -> Picture:
    notes = list(picture.warnings)
    if picture.is_one_tone:
        notes.append(Phrase("is one tone all over: the light will be even, with nothing to see in it"))
    if picture.width < settings.pixels // 2 or picture.height < picture.linear.shape[0] // 2:
        ny, nx = picture.linear.shape
        notes.append(_describe_enlarged((picture.width, picture.height), (nx, ny)))
    return replace(picture, warnings=tuple(notes))


def _describe_enlarged(size: tuple[int, int], to: tuple[int, int]) -> Phrase:
    """Return a warning without its subject, the picture; sizes as columns and rows."""
    (width, height), (columns, rows) = size, to
    return Phrase(
        "has {width} x {height} pixels, enlarged to {columns} x {rows}",
        width=width,
        height=height,
        columns=columns,
        rows=rows,
    )


def _spans(width: int, height: int, fit: str, aspect: float) -> tuple[Span, Span]:
    """Return the part of the picture, in its own pixels, that fills the screen: columns and rows."""
    across, down = Span(0.0, float(width)), Span(0.0, float(height))
    too_wide = width > height * aspect
    if fit == "stretch" or width == height * aspect:
        return across, down
    if (fit == "crop") == too_wide:
        return Span.centre_on(width / 2, height * aspect), down
    return across, Span.centre_on(height / 2, width / aspect)


def resample_picture(
    tones: ToneReader, shape: tuple[int, int], across: Span, down: Span, *, invert: bool = False
) -> Array:
    """Return (rows, columns) of linear light, computed strip by strip so that a large picture is never held in floating
    point as a whole.
    """
    width, height = tones.picture.image.size
    columns, lines = weights_to_resample(width, across, shape[1]), weights_to_resample(height, down, shape[0])
    result = np.zeros(shape)
    step = max(1, _STRIP_PIXELS // width)
    for top in range(0, height, step):
        bottom = min(height, top + step)
        strip = tones.read_strip(top, bottom)
        if invert:
            strip = invert_tones(strip, tones.tone)
        result += lines[:, top:bottom] @ (columns @ strip.T).T
    return np.clip(result, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WallPhoto:
    """light (h, w): linear, 1 = the camera's white, row 0 on top; width, height: of the file [pixels]."""

    light: Array
    width: int
    height: int


def read_wall_photo(path: Path, *, limits: PictureLimits = OWN_PICTURE, name: str | None = None) -> WallPhoto:
    """Return the photograph at `path`, upright. PictureError, one line, which calls it by `name`, by default its path.

    Pixels in which even one colour is clipped count as white, because their light is not known.
    """
    name = name or str(path)
    decoded = decode_picture(path, limits, name)
    image, (width, height) = decoded.image, decoded.image.size
    share = min(1.0, _PHOTO_PIXELS / max(width, height))
    shape = max(1, round(height * share)), max(1, round(width * share))
    try:
        tones = ToneReader.of(decoded, tone="srgb")
        light = resample_picture(tones, shape, Span(0.0, float(width)), Span(0.0, float(height)))
        if not is_deep(image):
            light = np.where(_mask_clipped(image, shape), 1.0, light)
    except MemoryError:
        raise too_large_for_memory(name, width, height) from None
    except ValueError as error:  # a mode that Pillow cannot turn into RGB
        raise unreadable(name, error) from None
    return WallPhoto(light=light, width=width, height=height)


def _mask_clipped(image: Image.Image, shape: tuple[int, int]) -> Array:
    """Return a mask of the pixels of that size of which most is clipped in some colour."""
    if image.mode not in ("L", "RGB"):
        image = image.convert("RGB")
    bright = None
    for channel in image.split():
        over = channel.point([255 if value >= _CLIPPED_BYTE else 0 for value in range(256)])
        smaller = np.asarray(over.resize((shape[1], shape[0]), Image.Resampling.BOX)) > 127
        bright = smaller if bright is None else bright | smaller
    return np.asarray(bright)


def light_rows(path: Path, *, tone: str) -> list[list[float]]:
    """Return the rows of `optics.light.profile`: relative strength, brightest 1, top row first, from rim to rim.

    Each value is the mean over the box around its point, so that noise and dust are averaged away; at the rims it is
    half a box. The picture shows exactly the aperture.
    """
    decoded = decode_picture(path, OWN_PICTURE, str(path))
    size = decoded.image.size
    (columns, across), (rows, down) = (_points(side) for side in size)
    covered = [
        np.asarray(weights_to_resample(side, span, count).sum(axis=1)).ravel()
        for side, span, count in ((size[0], across, columns), (size[1], down, rows))
    ]
    try:
        light = resample_picture(ToneReader.of(decoded, tone=tone), (rows, columns), across, down)
    except ValueError as error:  # values that are not tones
        raise unreadable(str(path), error) from None
    light /= covered[1][:, None] * covered[0][None, :]
    if not light.max() > 0:
        raise PictureError(Phrase("{path}: the picture of the light is black everywhere", path=path))
    return [[round(float(value), 4) for value in row] for row in light / light.max()]


def _points(size: int) -> tuple[int, Span]:
    """Return the number of points along an axis of that many pixels, and the spans of the boxes around them."""
    count = min(size, _MOST_NODES)
    half = size / (count - 1) / 2
    return count, Span(-half, size + half)
