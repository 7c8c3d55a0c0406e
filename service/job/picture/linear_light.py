"""Pixel values of a decoded picture -> linear-light luminance, clear parts over white; the sRGB curve both ways.

LittleCMS converts stored values to displayed ones by the picture's colour profile. Colour pictures are converted to
sRGB in 8 bits, as in every viewer. Grey ones keep their 16 bits: a row of greys is converted once, to our own grey
profile with the curve of sRGB.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageCms

from phrases.phrase import Phrase
from service.job.picture.decoding import Colorimetry, DecodedPicture

Array = npt.NDArray[np.float64]

_GREY_MODES = ("1", "L", "LA", "La", "I")
_D50 = (0.9642, 1.0, 0.8249)  # ICC.1: the white of profiles
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_GAMMAS = (0.1, 10.0)
_STEPS = 65535.0
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 / sRGB primaries, in linear light
_SENSOR_BITS = (8, 10, 12, 14, 16, 24)


class ProfileError(Exception):
    """A colour profile is damaged, or belongs to another kind of picture."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Conversion:
    """grey: (65536,) sRGB values in [0, 1] of greys in equal steps; colour: pixels of 8 bits to sRGB. One is None."""

    grey: Array | None = None
    colour: ImageCms.ImageCmsTransform | None = None

    def convert_greys(self, values: Array) -> Array:
        """Convert grey values in [0, 1] to sRGB values."""
        if self.grey is None:
            return values
        return np.asarray(self.grey[np.rint(values * _STEPS).astype(np.uint16)])

    def convert_colours(self, image: Image.Image) -> Image.Image:
        """Convert RGB or CMYK pixels to sRGB."""
        return image.convert("RGB") if self.colour is None else self.colour.apply(image)


def find_conversion(picture: DecodedPicture) -> Conversion:
    """Return how this picture's values become sRGB. ProfileError if its profile cannot be used."""
    if picture.colour is None:
        return Conversion()
    mode = picture.image.mode
    grey = mode in _GREY_MODES or mode.startswith("I;16")
    try:
        profile = _open(picture.colour, grey=grey)
        space = profile.profile.xcolor_space.strip()
        if grey and space in ("GRAY", "RGB"):
            return Conversion(grey=_tabulate_greys(profile, space))
        if space != ("CMYK" if mode == "CMYK" else "RGB"):
            raise ProfileError(space)
        return Conversion(
            colour=ImageCms.buildTransform(profile, _make_srgb(), "CMYK" if mode == "CMYK" else "RGB", "RGB")
        )
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError, MemoryError) as error:
        raise ProfileError(str(error)) from None


def _open(colour: bytes | Colorimetry, *, grey: bool) -> ImageCms.ImageCmsProfile:
    return ImageCms.ImageCmsProfile(
        io.BytesIO(colour if isinstance(colour, bytes) else _make_profile(colour, grey=grey))
    )


def _tabulate_greys(profile: ImageCms.ImageCmsProfile, space: str) -> Array:
    """Return the sRGB values of all greys. Avoid LittleCMS's shortcuts, which miss dark greys by half."""
    if space == "GRAY":
        greys = Image.fromarray(np.arange(65536, dtype=np.uint16).reshape(256, 256))
    else:
        greys = Image.fromarray(np.arange(256, dtype=np.uint8).reshape(16, 16)).convert("RGB")
    exact = ImageCms.Flags.NOOPTIMIZE | ImageCms.Flags.NOCACHE
    mode = "I;16" if space == "GRAY" else "RGB"
    transform = ImageCms.buildTransform(profile, _make_grey_srgb(), mode, "I;16", flags=exact)
    found = np.asarray(transform.apply(greys)).ravel() / _STEPS
    return np.interp(np.arange(65536) / _STEPS, np.linspace(0.0, 1.0, found.size), found)


@cache
def _make_srgb() -> ImageCms.ImageCmsProfile:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))


@cache
def _make_grey_srgb() -> ImageCms.ImageCmsProfile:
    curve = _pack_curve(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
    return ImageCms.ImageCmsProfile(io.BytesIO(_pack_profile(b"GRAY", {b"kTRC": curve})))


def _make_profile(colour: Colorimetry, *, grey: bool) -> bytes:
    """Return a profile for a gamma and primaries. ValueError if they are impossible."""
    if not _GAMMAS[0] <= colour.gamma <= _GAMMAS[1]:
        raise ValueError(colour.gamma)
    curve = _pack_curve(0, colour.gamma)
    if grey:
        return _pack_profile(b"GRAY", {b"kTRC": curve})
    columns = _compute_colorants(colour).T
    named = zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns, strict=True)
    return _pack_profile(
        b"RGB ", {b"rTRC": curve, b"gTRC": curve, b"bTRC": curve} | {name: _pack_xyz(*column) for name, column in named}
    )


def _compute_colorants(colour: Colorimetry) -> Array:
    """Return XYZ of red, green, blue as columns, white adapted to D50 by Bradford's matrix (ICC.1, annex E)."""
    points = np.array([colour.red, colour.green, colour.blue, colour.white])
    x, y = points.T
    if not (np.isfinite(points).all() and (y > 0).all()):
        raise ValueError(points)
    xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    try:
        primaries = xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
    except np.linalg.LinAlgError:
        raise ValueError(points) from None
    gains = (_BRADFORD @ np.array(_D50)) / (_BRADFORD @ xyz[:, 3])
    return np.asarray(np.linalg.inv(_BRADFORD) @ np.diag(gains) @ _BRADFORD @ primaries)


def _pack_profile(space: bytes, tags: Mapping[bytes, bytes]) -> bytes:
    """Return a display profile of version 4 (ICC.1:2010, 7)."""
    words = b"mluc" + bytes(4) + struct.pack(">II2s2sII", 1, 12, b"en", b"US", 2, 28) + "-".encode("utf-16-be")
    named = {b"desc": words, b"cprt": words, b"wtpt": _pack_xyz(*_D50), **tags}
    table, data, start = b"", b"", 128 + 4 + 12 * len(named)
    for name, content in named.items():
        table += name + struct.pack(">II", start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    header = struct.pack(">I4xI4s4s4s12x4s28x", start + len(data), 0x04200000, b"mntr", space, b"XYZ ", b"acsp")
    return header + _pack_xyz(*_D50)[8:] + bytes(48) + struct.pack(">I", len(named)) + table + data


def _pack_xyz(*values: float) -> bytes:
    return b"XYZ " + bytes(4) + _pack_fixed(*values)


def _pack_curve(kind: int, *values: float) -> bytes:
    return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + _pack_fixed(*values)


def _pack_fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def srgb_to_linear(encoded: Array) -> Array:
    """Convert by IEC 61966-2-1, for values in [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: Array) -> Array:
    """Convert by IEC 61966-2-1, for values in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055)


def invert_tones(linear: Array, tone: str) -> Array:
    """Return the negative: 1 - value in the tones the picture is written in, as an image editor does it."""
    if tone == "linear":
        return 1.0 - linear
    return srgb_to_linear(1.0 - linear_to_srgb(np.clip(linear, 0.0, 1.0)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ToneReader:
    """Converts the pixels of one decoded picture to light.

    white    : the stored value that means white
    warnings : for the person, about how they are read; sentences without their subject, the picture
    """

    picture: DecodedPicture
    tone: str
    white: float
    conversion: Conversion
    warnings: tuple[Phrase, ...]

    @classmethod
    def of(cls, picture: DecodedPicture, *, tone: str) -> ToneReader:
        """Examine the picture and return its reader. ValueError if its values are not tones."""
        white, warnings = _find_white(picture)
        conversion = Conversion()
        if picture.image.mode != "F" and picture.colour is not None:
            if tone == "linear":
                warnings.append(
                    Phrase("has colour information that is not used: with image.tone = linear its values are light")
                )
            else:
                try:
                    conversion = find_conversion(picture)
                except ProfileError:
                    warnings.append(
                        Phrase("has a colour profile that is damaged or of another kind: it is taken as sRGB")
                    )
        if picture.has_more_frames:
            warnings.append(Phrase("holds more than one picture: the first one is used"))
        return cls(picture=picture, tone=tone, white=white, conversion=conversion, warnings=tuple(warnings))

    def read_strip(self, top: int, bottom: int) -> Array:
        """Return luminance (bottom - top, columns) in [0, 1], in linear light, transparent parts over white.

        Floating-point pictures ("F") hold linear light by convention; the tone does not apply to them.
        """
        image = self.picture.image
        strip = image.crop((0, top, image.width, bottom))
        if is_deep(image):
            return self._read_deep(strip)
        if has_alpha(image):
            if "transparency" in image.info:
                strip.info["transparency"] = image.info["transparency"]
            grey = strip.mode in ("1", "L", "LA", "La")
            pixels = (strip.convert("LA") if strip.mode == "La" else strip).convert("RGBA")
            opacity = np.asarray(pixels.getchannel("A")) / 255.0
            return opacity * self._luminance(pixels.getchannel("R") if grey else pixels.convert("RGB")) + (
                1.0 - opacity
            )
        if strip.mode in ("1", "L"):
            return self._luminance(strip.convert("L"))
        return self._luminance(strip if strip.mode == "CMYK" else strip.convert("RGB"))

    def _read_deep(self, strip: Image.Image) -> Array:
        raw = _values(strip, self.picture)
        values = np.clip(raw.astype(np.float64) / self.white, 0.0, 1.0)
        if self.picture.white_is_zero:
            values = 1.0 - values
        if strip.mode == "F":
            return values
        linear = self._linearise(self.conversion.convert_greys(values))
        clear = self.picture.image.info.get("transparency")
        return np.where(raw == clear, 1.0, linear) if isinstance(clear, int) else linear

    def _luminance(self, image: Image.Image) -> Array:
        """Return the light of L, RGB or CMYK pixels."""
        steps = np.arange(256) / 255.0
        if image.mode == "L":
            return np.asarray(self._linearise(self.conversion.convert_greys(steps))[np.asarray(image)])
        pixels, table = np.asarray(self.conversion.convert_colours(image)), self._linearise(steps)
        result = np.zeros(pixels.shape[:2])
        for channel, share in enumerate(_LUMINANCE):
            result += (share * table)[pixels[..., channel]]
        return result

    def _linearise(self, values: Array) -> Array:
        return srgb_to_linear(values) if self.tone == "srgb" else values


def is_deep(image: Image.Image) -> bool:
    """Return whether pixels have more than 8 bits; they are grey then."""
    return image.mode in ("I", "F") or image.mode.startswith("I;16")


def has_alpha(image: Image.Image) -> bool:
    """Return whether pixels of 8 bits may be transparent."""
    return image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info


def _values(image: Image.Image, picture: DecodedPicture) -> npt.NDArray[Any]:
    raw = np.asarray(image)
    return raw.view(np.uint32) if picture.is_unsigned_32 and image.mode == "I" else raw


def _find_white(picture: DecodedPicture) -> tuple[float, list[Phrase]]:
    """Return the stored value that means white, and a warning if that is a guess.

    Files of 16 and 32 bits often hold the 8 to 14 bits of a sensor, unspread: white is the least number of bits that
    the brightest value needs.
    """
    if not is_deep(picture.image):
        return 255.0, []
    values = _values(picture.image, picture)
    if picture.image.mode == "F":
        if not np.isfinite(values).all():
            raise ValueError(Phrase("it holds values that are not finite"))
        highest = float(values.max())
        if highest <= 1.0:
            return 1.0, []
        words = Phrase("holds amounts of light up to {highest:.4g}: the highest is taken as white", highest=highest)
        return highest, [words]
    if values.min() < 0:
        raise ValueError(Phrase("it holds negative values"))
    highest, full = int(values.max()), picture.full_scale
    bits = next((bits for bits in _SENSOR_BITS if highest < 2**bits < full), None)
    if bits is None:
        return float(full), []
    words = Phrase(
        "holds no value above {highest} of {full}: it is read as a picture of {bits} bits, with white at {white}",
        highest=highest,
        full=full,
        bits=bits,
        white=2**bits - 1,
    )
    return float(2**bits - 1), [words]
