"""From a picture file to the light that a lens aims at; here, what a picture may be before it is decoded, and what it
then was, so that neither arrays nor decoders are imported to say it.
"""

from __future__ import annotations

from dataclasses import dataclass

FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF")  # Pillow's names; no other decoder of Pillow is ever tried


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureLimits:
    """What is decoded at all; a server gives its own `max_megapixels`, of service/settings."""

    max_pixels: int


OWN_PICTURE = PictureLimits(max_pixels=100_000_000)  # of a person at the command line


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureFacts:
    """What a readable picture is: its size in pixels as stored, Pillow's names of format and mode."""

    width: int
    height: int
    format: str
    mode: str
