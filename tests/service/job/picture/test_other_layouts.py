"""JPEG, BMP, WebP and GIF as other programs write them: read with their tones, or refused by name."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from service.errors import PictureError
from service.job.picture.reading import read_picture
from service.job.spec.model import ImageSpec
from tests.service.job.picture.samples import COLUMNS, HUES, ROWS, SHARES, SMOOTH, Array, linear_of

INKS = np.concatenate([1.0 - HUES, np.zeros((ROWS, COLUMNS, 1))], axis=-1)
OPACITY = 0.4 + 0.6 * SMOOTH


LIGHT = linear_of(HUES) @ SHARES
CLEARER = OPACITY * LIGHT + 1.0 - OPACITY
Row = tuple[str, bytes, Array | None]


def bytes_of(values: Array, bits: int = 8) -> Array:
    return np.round(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def jpegs() -> Iterator[Row]:
    """None: such a file is refused."""
    encode = imagecodecs.jpeg_encode
    for level in (95, 100):
        yield f"grey {level}", encode(bytes_of(SMOOTH), level=level), linear_of(SMOOTH)
        yield f"colour {level}", encode(bytes_of(HUES), level=level), LIGHT
        yield f"rgb {level}", encode(bytes_of(HUES), level=level, colorspace="rgb", outcolorspace="rgb"), LIGHT
        for inks in ("cmyk", "ycck"):  # inverted, as Adobe writes them
            file = encode(255 - bytes_of(INKS), level=level, colorspace="cmyk", outcolorspace=inks)
            yield f"{inks} {level}", file, LIGHT
        yield f"12 bits {level}", encode(bytes_of(SMOOTH, 12), level=level, bitspersample=12), None
    for subsampling in ("444", "422", "420", "440"):
        yield subsampling, encode(bytes_of(HUES), level=98, subsampling=subsampling), LIGHT
    yield "lossless", encode(bytes_of(HUES), lossless=True), LIGHT
    yield "lossless 16", encode(bytes_of(SMOOTH, 16), lossless=True, bitspersample=16), None
    yield "JPEG LS", imagecodecs.jpegls_encode(bytes_of(SMOOTH)), None


def webps() -> Iterator[Row]:
    alpha = np.dstack([HUES, OPACITY])
    for lossless in (True, False):
        yield f"webp {lossless}", imagecodecs.webp_encode(bytes_of(HUES), lossless=lossless, level=95), LIGHT
        yield f"webp alpha {lossless}", imagecodecs.webp_encode(bytes_of(alpha), lossless=lossless, level=95), CLEARER


def bmp(
    bits: int, pixels: Array, *, masks: bytes = b"", palette: bytes = b"", head: int = 40, up: bool = True
) -> bytes:
    """pixels (rows, bytes)."""
    body = b"".join(row.tobytes() + bytes(-len(row.tobytes()) % 4) for row in (pixels[::-1] if up else pixels))
    more = masks + bytes(head - 40 - len(masks)) if head > 40 else masks
    start = 14 + 40 + len(more) + len(palette)
    sizes = (head, COLUMNS, ROWS if up else -ROWS, 1, bits, 3 if masks else 0, len(body), 0, 0, len(palette) // 4, 0)
    header = struct.pack("<IiiHHIIiiII", *sizes)
    return b"BM" + struct.pack("<IHHI", start + len(body), 0, 0, start) + header + more + palette + body


def bmps() -> Iterator[Row]:
    bgr = bytes_of(HUES)[..., ::-1]
    for up in (True, False):
        yield f"24 {up}", bmp(24, bgr, up=up), LIGHT
    for fourth in (0, 100, 255):  # which means nothing
        yield f"32 {fourth}", bmp(32, np.dstack([bgr, np.full((ROWS, COLUMNS), fourth, np.uint8)])), LIGHT
    bgra = np.dstack([bgr, bytes_of(OPACITY)])
    masks = struct.pack("<IIII", 0xFF0000, 0xFF00, 0xFF, 0xFF000000)
    for head in (108, 124):
        yield f"32 with alpha {head}", bmp(32, bgra, masks=masks, head=head), CLEARER
    yield "32 with masks", bmp(32, bgra, masks=masks[:12]), LIGHT
    rgb10 = np.round(HUES * 1023).astype(np.uint32) @ np.array([1 << 20, 1 << 10, 1], dtype=np.uint32)
    yield "3 x 10", bmp(32, rgb10.astype("<u4"), masks=struct.pack("<III", 0x3FF00000, 0xFFC00, 0x3FF)), None
    fives = np.round(HUES * 31).astype(np.uint16)
    yield (
        "3 x 5",
        bmp(16, (fives @ np.array([1024, 32, 1], dtype=np.uint16)).astype("<u2")),
        linear_of(fives / 31) @ SHARES,
    )
    for bits, turned in itertools.product((1, 4, 8), (False, True)):
        count = 2**bits
        levels = np.arange(count)[:: -1 if turned else 1] * 255 // (count - 1)
        palette = np.stack([levels, levels, levels, np.zeros(count, int)], axis=-1).astype(np.uint8)
        indices = np.round(SMOOTH * (count - 1)).astype(int)
        spread = ((indices[..., None] >> np.arange(bits - 1, -1, -1)) & 1).reshape(ROWS, -1).astype(np.uint8)
        file = bmp(bits, np.packbits(spread, axis=1), palette=palette.tobytes())
        yield f"palette {bits} {turned}", file, linear_of(levels[indices] / 255.0)


@pytest.mark.parametrize(("name", "file", "light"), [*jpegs(), *webps(), *bmps()], ids=lambda one: str(one)[:20])
def test_each_layout_is_read_with_its_tones_or_refused_by_name(
    tmp_path: Path, name: str, file: bytes, light: Array | None
) -> None:
    (tmp_path / "a").write_bytes(file)
    spec = ImageSpec(pixels=COLUMNS)
    if light is None:
        with pytest.raises(PictureError, match="rare kind that is not read"):
            read_picture(tmp_path / "a", spec, rows=ROWS, aspect=COLUMNS / ROWS)
    else:
        found = read_picture(tmp_path / "a", spec, rows=ROWS, aspect=COLUMNS / ROWS)
        np.testing.assert_allclose(found.linear, light, atol=0.06)


@pytest.mark.parametrize("kind", ["avif", "jpegxl", "jpeg2k", "jpegxr", "qoi"])
def test_a_picture_of_another_format_is_refused_with_those_that_are_read(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a").write_bytes(getattr(imagecodecs, f"{kind}_encode")(bytes_of(HUES)))
    with pytest.raises(PictureError, match=r"\(PNG, JPEG, TIFF, WebP, BMP, GIF can\)"):
        read_picture(tmp_path / "a", ImageSpec(pixels=COLUMNS), rows=ROWS, aspect=COLUMNS / ROWS)
