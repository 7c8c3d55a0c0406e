"""Pixel values of a decoded picture -> linear-light luminance, clear parts over white; the sRGB curve both ways."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from phrases.phrase import Phrase
from service.job.picture.colour import Conversion, ProfileError, find_conversion
from service.job.picture.decoding import DecodedPicture

Array = npt.NDArray[np.float64]

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 / sRGB primaries, in linear light
_SENSOR_BITS = (8, 10, 12, 14, 16, 24)


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
    """How the pixels of one decoded picture become light.

    white    : the stored value that means white
    warnings : what the person should know of how they are read; sentences without their subject, the picture
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
    """Return the stored value that means white, and a warning where that is a guess.

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
