"""From a picture file to the target light of a lens. This module has the limits of a picture before it is decoded, and
the facts about it afterwards; it imports neither arrays nor decoders.
"""

from __future__ import annotations

from dataclasses import dataclass

FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF")  # Pillow's names; its other decoders are never tried


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureLimits:
    """Limits for decoding; a server sets its own `max_megapixels` (service/settings)."""

    max_pixels: int


OWN_PICTURE = PictureLimits(max_pixels=100_000_000)  # for a person's own picture at the command line


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureFacts:
    """Facts about a readable picture: its size in pixels as stored, Pillow's names of format and mode."""

    width: int
    height: int
    format: str
    mode: str
