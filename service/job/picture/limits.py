"""What a picture may be before it is decoded, and what it then was; apart from `picture` and `decoding`, so that
neither arrays nor decoders are imported to say it."""

from __future__ import annotations

from dataclasses import dataclass

UPLOAD_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF")


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureLimits:
    """What is decoded at all; a server gives its own `max_megapixels`, of service/settings.

    formats : Pillow's names; empty: all that need no other program
    """

    max_pixels: int
    formats: tuple[str, ...] = UPLOAD_FORMATS


OWN_PICTURE = PictureLimits(max_pixels=100_000_000, formats=())  # of a person at the command line


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureFacts:
    """What a readable picture is: its size in pixels as stored, Pillow's names of format and mode."""

    width: int
    height: int
    format: str
    mode: str
