"""A picture file -> its pixels, or one line that says why not. Imports no arrays: the server's checker stays small."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image, ImageOps, UnidentifiedImageError

from phrases.phrase import Phrase
from service.errors import PictureError, printable, sentence_of_os_error
from service.job.picture.limits import PictureFacts, PictureLimits

MIN_SIDE = 8
_NEEDS_A_PROGRAM = {"EPS", "WMF"}  # Pillow hands these to Ghostscript or to Windows


def decode_picture(path: Path, limits: PictureLimits, name: str) -> Image.Image:
    """Return the first frame, decoded and upright. PictureError, one line that calls the picture by `name`."""
    with _translate_refusals(name, limits), _load(path, limits, name) as image:
        upright = ImageOps.exif_transpose(image)
        return upright.copy() if upright is image else upright


def check_picture(path: Path, limits: PictureLimits, name: str) -> PictureFacts:
    """Decode the picture whole, as `decode_picture` does, and keep nothing of it."""
    with _translate_refusals(name, limits), _load(path, limits, name) as image:
        image.getexif()
        _require_convertible(image, name)
        return PictureFacts(width=image.width, height=image.height, format=image.format or "", mode=image.mode)


def one_line(error: Exception) -> str:
    """Return what a library says of a picture, short."""
    return printable(" ".join(str(error).split()))[:120] or type(error).__name__


@contextmanager
def _load(path: Path, limits: PictureLimits, name: str) -> Iterator[Image.Image]:
    """Open a picture. Every refusal that the header allows comes before decoding; its name says nothing of its kind."""
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's remarks on odd but readable files
        if not file.read(1):
            raise PictureError(Phrase("{name}: the file is empty", name=name))
        with Image.open(file, formats=limits.formats or _formats()) as image:
            _require_size(name, limits, *image.size)
            image.load()
            yield image


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
    except UnidentifiedImageError:
        can = _readable(limits)
        raise PictureError(Phrase("{name}: not a picture that can be read ({can} can)", name=name, can=can)) from None
    except MemoryError:
        raise PictureError(Phrase("{name}: does not fit in memory", name=name)) from None
    except OSError as error:
        if error.errno is None:  # Pillow's own: truncated, broken data stream ...
            raise _tell_damage(name, error) from None
        error.filename = name
        raise PictureError(sentence_of_os_error(error, doing=Phrase("cannot read the picture"))) from None
    except Exception as error:  # decoders raise anything on damaged data: struct.error, IndexError, SyntaxError ...
        raise _tell_damage(name, error) from None


def _tell_damage(name: str, error: Exception) -> PictureError:
    return PictureError(Phrase("{name}: the picture is damaged ({cause})", name=name, cause=one_line(error)))


def unreadable(name: str, error: Exception) -> PictureError:
    """Return the refusal of a picture whose mode cannot be turned into tones."""
    return PictureError(Phrase("{name}: cannot read its pixels ({cause})", name=name, cause=one_line(error)))


def too_large_for_memory(name: str, width: int, height: int) -> PictureError:
    """Return the refusal of a picture that there is no memory for."""
    return PictureError(
        Phrase("{name}: {width} x {height} pixels do not fit in memory", name=name, width=width, height=height)
    )


def _readable(limits: PictureLimits) -> str:
    return ", ".join(limits.formats).replace("WEBP", "WebP") or "PNG, JPEG, TIFF, WebP, GIF ..."


def _formats() -> list[str]:
    Image.init()
    return [name for name in Image.ID if name not in _NEEDS_A_PROGRAM]


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
    """Refuse a mode that cannot be read as tones: one pixel tells."""
    if image.mode not in ("I", "F") and not image.mode.startswith("I;16"):
        try:
            image.crop((0, 0, 1, 1)).convert("RGB")
        except ValueError as error:
            raise unreadable(name, error) from None


def _bomb_pixels(error: Exception) -> str:
    numbers = [word.strip("()") for word in str(error).split() if word.strip("()").isdigit()]
    return numbers[0] if numbers else Phrase("too many")
