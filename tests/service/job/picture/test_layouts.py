"""A picture in every layout of PNG, written here byte by byte, and JPEG, BMP, WebP and GIF as other programs write
them: read with their tones, or refused by name.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest

from service.errors import PictureError
from service.job.picture.reading import Picture, read_picture
from service.job.spec.model import ImageSpec
from service.server.api.intake.child_requests import PictureChecker
from tests.service.job.picture.samples import (
    COLOURS,
    COLUMNS,
    GREY,
    HUES,
    OPACITY,
    ROWS,
    SHARES,
    SMOOTH,
    Array,
    linear_of,
)

GREY_TYPE, RGB_TYPE, PALETTE_TYPE, GREY_ALPHA_TYPE, RGBA_TYPE = 0, 2, 3, 4, 6
INKS = np.concatenate([1.0 - HUES, np.zeros((ROWS, COLUMNS, 1))], axis=-1)
EVEN_OPACITY = 0.4 + 0.6 * SMOOTH
LIGHT = linear_of(HUES) @ SHARES
CLEARER = EVEN_OPACITY * LIGHT + 1.0 - EVEN_OPACITY
Row = tuple[str, bytes, Array | None]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(samples: Array, bits: int, colour_type: int, *extra: bytes, after: bytes = b"") -> bytes:
    """samples (rows, columns, channels) as numbers of so many bits; extra: chunks before the pixels."""
    rows, columns = samples.shape[:2]
    flat = samples.reshape(rows, -1)
    if bits == 16:
        packed = flat.astype(">u2").view(np.uint8)
    else:
        spread = (flat[:, :, None] >> np.arange(bits - 1, -1, -1)) & 1
        packed = np.packbits(spread.reshape(rows, -1).astype(np.uint8), axis=1)
    lines = b"".join(b"\0" + row.tobytes() for row in packed.reshape(rows, -1))
    header = struct.pack(">IIBBBBB", columns, rows, bits, colour_type, 0, 0, 0)
    pixels = chunk(b"IDAT", zlib.compress(lines))
    return b"".join([b"\x89PNG\r\n\x1a\n", chunk(b"IHDR", header), *extra, pixels, after, chunk(b"IEND", b"")])


def stored(values: Array, bits: int) -> Array:
    whole = np.round(values * (2**bits - 1)).astype(np.int64)
    return whole if whole.ndim == 3 else whole[..., None]


def read(path: Path, **settings: Any) -> Picture:
    spec = ImageSpec(pixels=COLUMNS, **settings)
    return read_picture(path, spec, rows=ROWS, aspect=COLUMNS / ROWS)


def layouts() -> Iterator[tuple[str, bytes, Array, float]]:
    """Name, file, light, allowed error."""
    for bits in (1, 2, 4, 8, 16):
        grey = stored(GREY, bits)
        light = linear_of(grey[..., 0] / (2**bits - 1))
        yield f"grey {bits}", png(grey, bits, GREY_TYPE), light, 1e-9
        clear = int(grey[2, 30, 0])
        transparency = chunk(b"tRNS", struct.pack(">H", clear))
        yield (
            f"grey {bits} one clear", png(grey, bits, GREY_TYPE, transparency),
            np.where(grey[..., 0] == clear, 1.0, light), 1e-9,
        )  # fmt: skip
    for bits in (8, 16):
        for name, kind, values, light in (
            ("rgb", RGB_TYPE, COLOURS, linear_of(COLOURS) @ SHARES),
            ("grey alpha", GREY_ALPHA_TYPE, np.dstack([GREY, OPACITY]), OPACITY * linear_of(GREY) + 1 - OPACITY),
            ("rgba", RGBA_TYPE, np.dstack([COLOURS, OPACITY]), OPACITY * (linear_of(COLOURS) @ SHARES) + 1 - OPACITY),
        ):
            yield f"{name} {bits}", png(stored(values, bits), bits, kind), light, 0.012
        rgb = stored(COLOURS, bits)
        clear = rgb[2, 30]
        transparency = chunk(b"tRNS", struct.pack(">HHH", *clear))
        whole = linear_of(COLOURS) @ SHARES
        yield (
            f"rgb {bits} one clear", png(rgb, bits, RGB_TYPE, transparency),
            np.where((rgb == clear).all(axis=-1), 1.0, whole), 0.012,
        )  # fmt: skip
    for bits in (1, 2, 4, 8):
        count = 2**bits
        indices = stored(GREY, bits)
        palette = np.stack([np.arange(count)[::-1], np.arange(count), np.full(count, 40)], axis=-1) * 255 // (count - 1)
        palette = np.clip(palette, 0, 255).astype(np.uint8)
        opacity = np.linspace(1.0, 0.0, count)
        table = linear_of(palette / 255.0) @ SHARES
        colours = chunk(b"PLTE", palette.tobytes())
        yield f"palette {bits}", png(indices, bits, PALETTE_TYPE, colours), table[indices[..., 0]], 1e-9
        clear_table = np.round(opacity * 255) / 255
        transparency = chunk(b"tRNS", np.round(opacity * 255).astype(np.uint8).tobytes())
        mixed = clear_table * table + 1 - clear_table
        file = png(indices, bits, PALETTE_TYPE, colours, transparency)
        yield f"palette {bits} clear", file, mixed[indices[..., 0]], 1e-9


@pytest.mark.parametrize(("name", "file", "light", "error"), list(layouts()), ids=lambda one: str(one)[:24])
def test_each_layout_is_read_with_its_tones_or_refused_by_name(
    tmp_path: Path, name: str, file: bytes, light: Array, error: float
) -> None:
    (tmp_path / "a.png").write_bytes(file)
    imagecodecs.png_decode(file)  # a good file
    if name == "rgb 16 one clear":
        with pytest.raises(PictureError, match="this PNG stores one transparent colour for RGB of 16 bits"):
            read(tmp_path / "a.png")
        return
    np.testing.assert_allclose(read(tmp_path / "a.png").linear, light, atol=error)


GOOD = (stored(GREY, 8), 8, GREY_TYPE)
TEXT = b"Comment\0" + b"x" * 3_000_000
NOTES = {
    "text": chunk(b"tEXt", TEXT),
    "many texts": chunk(b"tEXt", TEXT) * 30,
    "compressed text": chunk(b"zTXt", b"Comment\0\0" + zlib.compress(b"x" * 70_000_000)),
    "international text": chunk(b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(b"x" * 3_000_000)),
    "broken text": chunk(b"zTXt", b"Comment\0\0" + b"no zlib"),
    "wrong sum": b"\0\0\0\4tEXtabcdwron",
    "odd chunk": chunk(b"vpAg", bytes(20_000_000)),
    "long profile": chunk(b"iCCP", b"p\0\0" + zlib.compress(bytes(3_000_000))),
    "bomb of a profile": chunk(b"iCCP", b"p\0\0" + zlib.compress(bytes(500_000_000))),
    "no profile": chunk(b"iCCP", b"p\0\0no zlib"),
}


@pytest.mark.parametrize(("note", "after"), list(itertools.product(NOTES, (False, True))))
def test_notes_of_any_length_never_stop_a_good_picture(tmp_path: Path, note: str, after: bool) -> None:
    extra = () if after else (NOTES[note],)
    file = png(*GOOD, *extra, after=NOTES[note] if after else b"")
    (tmp_path / "a.png").write_bytes(file)
    np.testing.assert_allclose(read(tmp_path / "a.png").linear, linear_of(stored(GREY, 8)[..., 0] / 255))


def test_the_server_takes_a_picture_with_long_notes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(png(*GOOD, NOTES["many texts"], NOTES["bomb of a profile"]))
    checker = PictureChecker()
    try:
        assert checker.check(tmp_path / "a", "a.png", 40_000_000).format == "PNG"
    finally:
        checker.close()


@pytest.mark.parametrize("code", [(9, 16, 0, 1), (9, 18, 0, 1), (12, 13, 0, 1)])
def test_wide_and_high_dynamic_range_colours_are_refused_by_name(tmp_path: Path, code: tuple[int, ...]) -> None:
    (tmp_path / "a.png").write_bytes(png(*GOOD, chunk(b"cICP", bytes(code))))
    with pytest.raises(PictureError, match="cICP"):
        read(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(png(*GOOD, chunk(b"cICP", bytes((1, 13, 0, 1)))))
    read(tmp_path / "a.png")


@pytest.mark.parametrize("seed", range(3))
def test_white_on_clear_says_that_clear_counts_as_white(tmp_path: Path, seed: int) -> None:
    opacity = np.random.default_rng(seed).integers(0, 2, (ROWS, COLUMNS)) * 255
    (tmp_path / "a.png").write_bytes(png(np.dstack([np.full_like(opacity, 255), opacity]), 8, GREY_ALPHA_TYPE))
    with pytest.raises(PictureError, match="clear parts count as white"):
        read(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(png(np.dstack([np.zeros_like(opacity), opacity]), 8, GREY_ALPHA_TYPE))
    np.testing.assert_allclose(read(tmp_path / "a.png").linear, opacity == 0)


def test_cut_short_it_is_damaged(tmp_path: Path) -> None:
    file = png(stored(np.random.default_rng(0).random((64, 64)), 8), 8, GREY_TYPE, NOTES["text"])
    for length in (len(file) - 2000, 3_000_000, 2000, 40):
        (tmp_path / "a.png").write_bytes(file[:length])
        with pytest.raises(PictureError):
            read(tmp_path / "a.png")


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
    alpha = np.dstack([HUES, EVEN_OPACITY])
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
    bgra = np.dstack([bgr, bytes_of(EVEN_OPACITY)])
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
def test_each_layout_of_jpeg_webp_and_bmp_is_read_or_refused_by_name(
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
