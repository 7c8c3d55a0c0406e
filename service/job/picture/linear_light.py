"""Pixel values of any Pillow mode -> linear-light luminance, clear parts over white; the sRGB curve both ways."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from phrases.phrase import Phrase

Array = npt.NDArray[np.float64]

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 / sRGB primaries, in linear light
_SIXTEEN_BIT = 65535


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


def value_scale(image: Image.Image) -> float:
    """Return the stored value that means white.

    32 bit integers are 16 bit data in practice unless they exceed it; floats above 1 are scaled to their maximum.
    Raises ValueError for floats that are not finite.
    """
    if image.mode.startswith("I;16"):
        return _SIXTEEN_BIT
    if image.mode == "I":
        highest = float(image.getextrema()[1])  # type: ignore[arg-type]
        return _SIXTEEN_BIT if highest <= _SIXTEEN_BIT else float(2**31 - 1)
    if image.mode == "F":
        values = np.asarray(image)
        if not np.isfinite(values).all():
            raise ValueError(Phrase("it holds values that are not finite"))
        return max(1.0, float(values.max()))
    return 255.0


def linearise_strip(strip: Image.Image, info: dict[Any, Any], *, tone: str, scale: float) -> Array:
    """Return luminance (rows, columns) in [0, 1] of some rows, in linear light, transparent parts over white.

    Floating-point pictures ("F") hold linear light whatever the tone says, as such files do by convention.
    """
    if strip.mode in ("I", "F") or strip.mode.startswith("I;16"):
        return _deep_strip(strip, info, tone=tone, scale=scale)
    if strip.mode in ("1", "L") and "transparency" not in info:
        return _table(tone)[np.asarray(strip.convert("L"))]
    clear = strip.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in info
    if not clear:
        return _luminance(np.asarray(strip.convert("RGB")), tone)
    if "transparency" in info:
        strip.info["transparency"] = info["transparency"]
    pixels = np.asarray(strip.convert("LA").convert("RGBA") if strip.mode == "La" else strip.convert("RGBA"))
    opacity = pixels[..., 3] / 255.0
    return opacity * _luminance(pixels, tone) + (1.0 - opacity)


def _deep_strip(strip: Image.Image, info: dict[Any, Any], *, tone: str, scale: float) -> Array:
    raw = np.asarray(strip)
    values = np.clip(raw.astype(np.float64) / scale, 0.0, 1.0)
    linear = srgb_to_linear(values) if tone == "srgb" and strip.mode != "F" else values
    clear = info.get("transparency")
    return np.where(raw == clear, 1.0, linear) if isinstance(clear, int) else linear


def _luminance(pixels: npt.NDArray[np.uint8], tone: str) -> Array:
    table = _table(tone)
    result = np.zeros(pixels.shape[:2])
    for channel, share in enumerate(_LUMINANCE):
        result += (share * table)[pixels[..., channel]]
    return result


def _table(tone: str) -> Array:
    """Return the linear light of the 256 values of one byte."""
    values = np.arange(256) / 255.0
    return srgb_to_linear(values) if tone == "srgb" else values
