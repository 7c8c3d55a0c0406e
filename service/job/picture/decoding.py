"""Decodes a picture file to pixels, or refuses it in one line. Imports no arrays: the server's checker stays small."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PIL import Image, ImageOps, UnidentifiedImageError
from PIL.PngImagePlugin import PngImageFile

from phrases.phrase import Phrase
from service.errors import PictureError, printable, sentence_of_os_error
from service.job.picture import FORMATS, PictureFacts, PictureLimits
from service.job.picture.layouts import PartsOfFile, PngChunks, TiffLayout, find_chunks, require_known_layout

MIN_SIDE = 8
Point = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Colorimetry:
    """Colours without a profile: light = value ** gamma; white and primaries as x, y of CIE 1931."""

    gamma: float
    white: Point
    red: Point
    green: Point
    blue: Point

    def is_like(self, other: Colorimetry) -> bool:
        """Return whether the two differ by less than an eye can see."""
        pairs = ((self.white, other.white), (self.red, other.red), (self.green, other.green), (self.blue, other.blue))
        near = all(abs(a - b) < 0.005 for ours, theirs in pairs for a, b in zip(ours, theirs, strict=True))
        return near and abs(self.gamma / other.gamma - 1) < 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DecodedPicture:
    """Pixels as Pillow gives them, upright, and properties that Pillow does not report.

    colour        : an ICC profile, or what stands in its place; None for sRGB
    full_scale    : the largest value that a sample of more than 8 bits can hold
    white_is_zero : samples of more than 8 bits count down from white
    is_unsigned_32: mode "I" holds unsigned numbers
    """

    image: Image.Image
    colour: bytes | Colorimetry | None = None
    full_scale: int = 65535
    white_is_zero: bool = False
    is_unsigned_32: bool = False
    has_more_frames: bool = False


_ADOBE_RGB = Colorimetry(
    gamma=563 / 256, white=(0.3127, 0.3290), red=(0.64, 0.33), green=(0.21, 0.71), blue=(0.15, 0.06)
)
_SRGB = Colorimetry(gamma=1 / 0.45455, white=(0.3127, 0.3290), red=(0.64, 0.33), green=(0.30, 0.60), blue=(0.15, 0.06))
_READABLE = ", ".join(FORMATS).replace("WEBP", "WebP")
_BEGINNINGS = (
    (rb"\x89PNG\r\n\x1a\n", "PNG"), (rb"\xff\xd8\xff", "JPEG"), (rb"II[*+]\0|MM\0[*+]", "TIFF"),
    (rb"RIFF....WEBP", "WebP"), (rb"GIF8[79]a", "GIF"),
)  # fmt: skip
_UNKNOWN_KIND = ("unsupported", "not supported", "unknown")  # as Pillow says it
_INTEROP_IFD, _INTEROP_INDEX = 0xA005, 1


def decode_picture(path: Path, limits: PictureLimits, name: str) -> DecodedPicture:
    """Return the first frame, decoded and upright. PictureError, one line that calls the picture by `name`."""
    with _translate_refusals(name, limits), _load(path, limits, name) as loaded:
        upright = ImageOps.exif_transpose(loaded.image)
        return replace(loaded, image=upright.copy() if upright is loaded.image else upright)


def check_picture(path: Path, limits: PictureLimits, name: str) -> PictureFacts:
    """Decode the picture whole, as `decode_picture` does, and keep nothing of it."""
    with _translate_refusals(name, limits), _load(path, limits, name) as loaded:
        image = loaded.image
        image.getexif()
        _require_convertible(image, name)
        return PictureFacts(width=image.width, height=image.height, format=image.format or "", mode=image.mode)


def one_line(error: Exception) -> str:
    """Return a library's message about a picture, shortened."""
    return printable(" ".join(str(error).split()))[:120] or type(error).__name__


@contextmanager
def _load(path: Path, limits: PictureLimits, name: str) -> Iterator[DecodedPicture]:
    """Open a picture. Every refusal that the header allows comes before decoding; the file's name does not determine
    its kind.
    """
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's remarks on odd but readable files
        if not (head := file.read(12)):
            raise PictureError(Phrase("{name}: the file is empty", name=name))
        chunks = find_chunks(file, name)
        layout = require_known_layout(file, name)
        source: Any = io.BufferedReader(PartsOfFile(file, chunks.parts)) if chunks else file
        with _open(source, head, name) as image:
            _require_size(name, limits, *image.size)
            units = _transparency_units(image, name)
            frames = _has_more_frames(image, layout)
            image.load()
            if units != 1 and isinstance(image.info.get("transparency"), int):
                image.info["transparency"] *= units
            yield DecodedPicture(
                image=image,
                colour=_colour_of(image, chunks),
                full_scale=layout.full_scale if layout else 65535,
                white_is_zero=layout is not None and layout.white_is_zero,
                is_unsigned_32=layout is not None and layout.is_unsigned_32,
                has_more_frames=frames,
            )


def _open(source: Any, head: bytes, name: str) -> Image.Image:
    try:
        return Image.open(source, formats=FORMATS)
    except UnidentifiedImageError:
        kind = next((kind for pattern, kind in _BEGINNINGS if re.match(pattern, head, re.DOTALL)), None)
        if kind is None:
            words = Phrase("{name}: not a picture that can be read ({can} can)", name=name, can=_READABLE)
        else:
            words = Phrase(
                "{name}: this {kind} is damaged, or of a rare kind that is not read; save it as PNG, grey or RGB of 8 "
                "or 16 bits",
                name=name,
                kind=kind,
            )
        raise PictureError(words) from None


def _has_more_frames(image: Image.Image, layout: TiffLayout | None) -> bool:
    return layout.has_more_pages if layout else bool(getattr(image, "is_animated", False))


def _transparency_units(image: Image.Image, name: str) -> int:
    """Return the factor for a PNG's transparent grey: the file states it in its own bits, and Pillow spreads pixels of
    fewer than 8 bits over 8.
    """
    if not (isinstance(image, PngImageFile) and "transparency" in image.info and image.tile):
        return 1
    stored = str(image.tile[0].args)
    if image.mode == "RGB" and "16" in stored:
        raise PictureError(
            Phrase(
                "{name}: this PNG stores one transparent colour for RGB of 16 bits, which is not read; save it with an "
                "alpha channel",
                name=name,
            )
        )
    return {"1": 255, "L;2": 85, "L;4": 17}.get(stored, 1)


def _colour_of(image: Image.Image, chunks: PngChunks | None) -> bytes | Colorimetry | None:
    """Return how the file defines its colours: a profile, else a gamma, else Exif's "Adobe RGB"; None for sRGB."""
    if chunks is None:
        profile = image.info.get("icc_profile")
        if isinstance(profile, bytes) and profile:
            return profile
        return _ADOBE_RGB if _is_adobe_rgb(image) else None
    if chunks.is_srgb or chunks.profile is not None:
        return None if chunks.is_srgb else chunks.profile
    gamma = image.info.get("gamma")
    if "srgb" in image.info or not gamma:
        return None
    found = replace(_SRGB, gamma=1 / gamma)
    if len(points := image.info.get("chromaticity", ())) == 8:
        white, red, green, blue = (tuple(points[place : place + 2]) for place in range(0, 8, 2))
        found = Colorimetry(gamma=1 / gamma, white=white, red=red, green=green, blue=blue)
    return None if found.is_like(_SRGB) else found  # writers of sRGB put 0.45455 there


def _is_adobe_rgb(image: Image.Image) -> bool:
    """Return whether Exif states Adobe RGB (DCF 2.0: interoperability "R03")."""
    if image.format not in ("JPEG", "MPO"):
        return False
    try:
        notes = image.getexif().get_ifd(_INTEROP_IFD)
    except Exception:  # Pillow may raise any error on damaged metadata, which does not damage the picture
        return False
    return str(notes.get(_INTEROP_INDEX, "")).strip("\0 ") == "R03"


@contextmanager
def _translate_refusals(name: str, limits: PictureLimits) -> Iterator[None]:
    try:
        yield
    except PictureError:
        raise
    except Image.DecompressionBombError as error:
        count, most = _bomb_pixels(error), limits.max_pixels
        words = Phrase("{name}: {count} pixels; allowed: at most {most}", name=name, count=count, most=most)
        raise PictureError(words) from None
    except MemoryError:
        raise PictureError(Phrase("{name}: does not fit in memory", name=name)) from None
    except OSError as error:
        if error.errno is None:  # Pillow's own: truncated, broken data stream ...
            raise _make_damage_error(name, error) from None
        error.filename = name
        raise PictureError(sentence_of_os_error(error, doing=Phrase("cannot read the picture"))) from None
    except Exception as error:  # decoders raise any error on damaged data: struct.error, IndexError, SyntaxError ...
        raise _make_damage_error(name, error) from None


def _make_damage_error(name: str, error: Exception) -> PictureError:
    if any(word in str(error).lower() for word in _UNKNOWN_KIND):
        return PictureError(
            Phrase(
                "{name}: the picture is of a rare kind that is not read ({cause}); save it as PNG, grey or RGB of 8 or "
                "16 bits",
                name=name,
                cause=one_line(error),
            )
        )
    return PictureError(Phrase("{name}: the picture is damaged ({cause})", name=name, cause=one_line(error)))


def unreadable(name: str, error: Exception) -> PictureError:
    """Return the refusal of a picture whose mode cannot be turned into tones."""
    return PictureError(Phrase("{name}: cannot read its pixels ({cause})", name=name, cause=one_line(error)))


def too_large_for_memory(name: str, width: int, height: int) -> PictureError:
    """Return the refusal of a picture that does not fit in memory."""
    return PictureError(
        Phrase("{name}: {width} x {height} pixels do not fit in memory", name=name, width=width, height=height)
    )


def _require_size(name: str, limits: PictureLimits, width: int, height: int) -> None:
    if width * height > limits.max_pixels:
        raise PictureError(
            Phrase(
                "{name}: {width} x {height} pixels are {count}; allowed: at most {most}",
                name=name,
                width=width,
                height=height,
                count=width * height,
                most=limits.max_pixels,
            )
        )
    if min(width, height) < MIN_SIDE:
        raise PictureError(
            Phrase(
                "{name}: {width} x {height} pixels; allowed: at least {least} x {least_height}",
                name=name,
                width=width,
                height=height,
                least=MIN_SIDE,
                least_height=MIN_SIDE,
            )
        )


def _require_convertible(image: Image.Image, name: str) -> None:
    """Refuse a mode that cannot be read as tones: one pixel shows it."""
    if image.mode not in ("I", "F") and not image.mode.startswith("I;16"):
        try:
            image.crop((0, 0, 1, 1)).convert("RGB")
        except ValueError as error:
            raise unreadable(name, error) from None


def _bomb_pixels(error: Exception) -> str:
    numbers = [word.strip("()") for word in str(error).split() if word.strip("()").isdigit()]
    return numbers[0] if numbers else Phrase("too many")
