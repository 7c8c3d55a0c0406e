"""One asymmetric picture in every layout of TIFF that tifffile writes: read with its tones, or refused by name."""

from __future__ import annotations

import io
import itertools
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from service.errors import PictureError
from service.job.picture import OWN_PICTURE
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

pytestmark = pytest.mark.filterwarnings("ignore")  # tifffile on what it dislikes


@dataclass(frozen=True, kw_only=True)
class Case:
    """data as it is written; light (rows, columns): what must be read, None for what tifffile reads; options of its
    `write`."""

    name: str
    data: Array
    light: Array | None
    options: dict[str, Any]
    byte_order: str = "<"
    error: float = 0.005  # of half a step of 8 bits

    def bytes(self) -> bytes | None:
        """The file; None where tifffile does not write such a one."""
        file = io.BytesIO()
        try:
            with tifffile.TiffWriter(file, byteorder=self.byte_order) as writer:
                writer.write(self.data, **{"metadata": None, **self.options})
        except (ValueError, TypeError, KeyError, NotImplementedError, RuntimeError, AttributeError):
            return None
        return file.getvalue() if "extratags" not in self.options else retagged(file.getvalue(), 332)


def stored(values: Array, kind: str, bits: int | None = None) -> Array:
    dtype = np.dtype(kind)
    if dtype.kind == "f":
        return values.astype(dtype)
    most = 2**bits - 1 if bits else int(np.iinfo(dtype).max)
    return np.round(values * most).astype(dtype)


def light_of(kind: str, values: Array) -> Array:
    """Floats hold light; all else tones. Colours as luminance."""
    linear = values if np.dtype(kind).kind == "f" else linear_of(values)
    return np.asarray(linear @ SHARES) if linear.ndim == 3 else linear


COMPRESSIONS: list[tuple[Any, bool]] = [
    (None, False), ("packbits", False), *itertools.product(("zlib", "lzw", "lzma", "zstd", "deflate"), (False, True)),
]  # fmt: skip
TILES = (None, (16, 16), (32, 16))


def greys() -> Iterator[Case]:
    kinds = ("uint8", "uint16", "uint32", "uint64", "int8", "int16", "int32", "float16", "float32", "float64")
    for kind, photometric, order, (compression, predictor), tile in itertools.product(
        kinds, ("minisblack", "miniswhite"), "<>", COMPRESSIONS, TILES
    ):
        values = 1.0 - GREY if photometric == "miniswhite" else GREY
        yield Case(
            name=f"{kind} {photometric} {order} {compression} {predictor} {tile}",
            data=stored(values, kind),
            light=light_of(kind, GREY),
            options={"photometric": photometric, "compression": compression, "predictor": predictor, "tile": tile},
            byte_order=order,
        )


def narrow_greys() -> Iterator[Case]:
    for bits, photometric, order, compression, tile in itertools.product(
        (1, 2, 4, 10, 12, 14), ("minisblack", "miniswhite"), "<>", (None, "zlib", "lzw", "packbits"), TILES
    ):
        kind = "uint8" if bits <= 8 else "uint16"
        data = stored(1.0 - GREY if photometric == "miniswhite" else GREY, kind, bits)
        tones = data / (2**bits - 1)
        yield Case(
            name=f"{bits} bits {photometric} {order} {compression} {tile}",
            data=data.astype(bool) if bits == 1 else data,
            light=linear_of(1.0 - tones if photometric == "miniswhite" else tones),
            options={"photometric": photometric, "compression": compression, "tile": tile}
            | ({} if bits == 1 else {"bitspersample": bits}),
            byte_order=order,
        )


def colours() -> Iterator[Case]:
    extras = (None, "unspecified", "assocalpha", "unassalpha")
    for kind, extra, order, (compression, predictor), planar, tile in itertools.product(
        ("uint8", "uint16", "uint32", "int8", "int16", "float32"),
        extras, "<>", COMPRESSIONS[:6], ("contig", "separate"), TILES[:2],
    ):  # fmt: skip
        values = COLOURS
        light = light_of(kind, COLOURS)
        if extra:
            scaled = COLOURS * OPACITY[..., None] if extra == "assocalpha" else COLOURS
            values = np.concatenate([scaled, OPACITY[..., None]], axis=-1)
        if extra in ("assocalpha", "unassalpha"):
            light = OPACITY * light + 1.0 - OPACITY
        data = stored(values, kind)
        yield Case(
            name=f"rgb {kind} {extra} {order} {compression} {predictor} {planar} {tile}",
            data=np.ascontiguousarray(np.moveaxis(data, -1, 0)) if planar == "separate" else data,
            light=light,
            options={
                "photometric": "rgb", "compression": compression, "predictor": predictor, "tile": tile,
                "planarconfig": planar, "extrasamples": [extra] if extra else None,
            },
            byte_order=order,
            error=0.012,  # of one step of 8 bits, with premultiplied alpha
        )  # fmt: skip


def others() -> Iterator[Case]:
    palette = np.stack([np.arange(256)[::-1] * 257, np.arange(256) * 257, np.full(256, 40 * 257)]).astype(np.uint16)
    indices = stored(GREY, "uint8")
    looked_up = np.moveaxis(palette[:, indices], 0, -1) / 65535.0
    inks = np.concatenate([1.0 - COLOURS, np.zeros((ROWS, COLUMNS, 1))], axis=-1)
    for order, compression, tile in itertools.product("<>", (None, "lzw", "zlib", "packbits"), TILES):
        plain: dict[str, Any] = {"compression": compression, "tile": tile}
        common = {"byte_order": order, "error": 0.012}
        tail = f"{order} {compression} {tile}"
        yield Case(
            name=f"palette {tail}", data=indices, light=light_of("uint8", looked_up),
            options={"photometric": "palette", "colormap": palette, **plain}, **common,
        )  # fmt: skip
        yield Case(
            name=f"palette of 8 bits {tail}", data=indices, light=light_of("uint8", looked_up),
            options={"photometric": "palette", "colormap": palette // 257, **plain}, **common,
        )  # fmt: skip
        for extra in ("unspecified", "assocalpha", "unassalpha"):
            light = light_of("uint8", GREY)
            first = GREY * OPACITY if extra == "assocalpha" else GREY
            for planar, kind in itertools.product(("contig", "separate"), ("uint8", "uint16")):
                yield Case(
                    name=f"grey {kind} {extra} {planar} {tail}",
                    data=stored(np.stack([first, OPACITY], axis=-1 if planar == "contig" else 0), kind),
                    light=light if extra == "unspecified" else OPACITY * light + 1.0 - OPACITY,
                    options={"photometric": "minisblack", "planarconfig": planar, "extrasamples": [extra], **plain},
                    **common,
                )
        for kind, planar, ink_set in itertools.product(("uint8", "uint16"), ("contig", "separate"), (1, 2)):
            data = stored(inks, kind)
            yield Case(
                name=f"cmyk {kind} {planar} {ink_set} {tail}",
                data=np.ascontiguousarray(np.moveaxis(data, -1, 0)) if planar == "separate" else data,
                light=light_of("uint8", COLOURS),
                options={
                    "photometric": "separated", "planarconfig": planar, "extratags": [(65000, 3, 1, ink_set, True)],
                    **plain,
                },
                **common,
            )  # fmt: skip
        for photometric in ("ycbcr", "cielab", "icclab", "itulab", "logluv", "linear_raw"):
            yield Case(
                name=f"{photometric} {tail}", data=stored(COLOURS, "uint8"), light=np.full(GREY.shape, np.nan),
                options={"photometric": photometric, **plain}, **common,
            )  # fmt: skip


def photographic() -> Iterator[Case]:
    """Smooth pictures, for these compressions keep no edges."""
    for kind, order, compression, tile in itertools.product(
        ("uint8", "uint16"), "<>", ("jpeg", "webp", "jpeg2000", "jpegxl", "jpegxr", "lerc", "png"), (None, (16, 16))
    ):
        for photometric, values, more in (
            ("minisblack", SMOOTH, {}), ("miniswhite", SMOOTH, {}), ("rgb", HUES, {}),
            ("rgb", HUES, {"planarconfig": "separate"}), ("ycbcr", HUES, {}),
            ("ycbcr", HUES, {"subsampling": (2, 2)}), ("ycbcr", HUES, {"subsampling": (2, 1)}),
        ):  # fmt: skip
            data = stored(values, kind)
            yield Case(
                name=f"{compression} {photometric} {more} {kind} {order} {tile}",
                data=np.moveaxis(data, -1, 0) if "planarconfig" in more else data,
                light=None if kind == "uint8" else np.full(GREY.shape, np.nan),
                options={"photometric": photometric, "compression": compression, "tile": tile, **more},
                byte_order=order,
                error=0.03,
            )


def retagged(content: bytes, code: int) -> bytes:
    """The file with its tag 65000 as another one, which tifffile does not write."""
    big = content[2:4] in (b"\0+", b"+\0")
    order = "<" if content[:2] == b"II" else ">"
    kind = struct.pack(f"{order}HH{'Q' if big else 'I'}", 65000, 3, 1)
    assert content.count(kind) == 1
    return content.replace(kind, struct.pack(f"{order}H", code) + kind[2:])


def read(path: Path) -> Picture:
    return read_picture(path, ImageSpec(pixels=COLUMNS), rows=ROWS, aspect=COLUMNS / ROWS, limits=OWN_PICTURE)


@pytest.mark.parametrize(
    ("cases", "least_read"),
    [(greys, 300), (narrow_greys, 30), (colours, 200), (others, 100), (photographic, 15)],
    ids=lambda one: getattr(one, "__name__", None),
)
def test_each_layout_is_read_with_its_tones_or_refused_by_name(tmp_path: Path, cases: Any, least_read: int) -> None:
    counts, wrong, path = Counter[str](), [], tmp_path / "a.tif"
    for case in cases():
        content = case.bytes()
        if content is None:
            continue
        path.write_bytes(content)
        light = case.light
        if light is None:
            decoded = tifffile.imread(path) / 255.0
            light = light_of("uint8", np.moveaxis(decoded, 0, -1) if decoded.shape[0] == 3 else decoded)
        try:
            picture = read(path)
        except PictureError as error:
            counts["refused"] += 1
            if "this TIFF stores" not in str(error):
                wrong.append(f"{case.name}: {error}")
            continue
        counts["read"] += 1
        if not np.abs(picture.linear - light).max() < case.error:  # not-a-number is wrong, too
            wrong.append(f"{case.name}: off by {np.abs(picture.linear - light).max():.3f}")
    assert not wrong, f"{len(wrong)} of {counts}: {wrong[:20]}"
    assert counts["read"] >= least_read, counts


@pytest.mark.parametrize(
    ("options", "refused"),
    [
        ({"bigtiff": True}, None),
        ({"bigtiff": True, "byteorder": ">"}, "stores BigTIFF, big-endian"),
        ({"byteorder": ">"}, None),
        ({"beginning": b"II\0*"}, None),
        ({"beginning": b"II\0*", "tag": (339, 4)}, "sample format 4"),
        ({"beginning": b"MM*\0", "byteorder": ">", "tag": (266, 2)}, "fill order 2"),
        ({"rowsperstrip": 1}, None),
        ({"rowsperstrip": 7}, None),
        ({"tag": (266, 2)}, "fill order 2"),
        ({"tag": (339, 4)}, "sample format 4"),
        ({"tag": (254, 1)}, "preview"),
    ],
)
def test_other_tags_are_obeyed_or_refused(tmp_path: Path, options: dict[str, Any], refused: str | None) -> None:
    file, more = tmp_path / "a.tif", dict(options)
    code, value = more.pop("tag", (65000, 0))
    more["extratags"] = [(65000, 3, 1, value, True)]
    beginning, size, order = more.pop("beginning", b""), more.pop("bigtiff", False), more.pop("byteorder", "<")
    with tifffile.TiffWriter(file, bigtiff=size, byteorder=order) as writer:
        writer.write(stored(GREY, "uint16"), metadata=None, photometric="minisblack", **more)
    content = retagged(file.read_bytes(), code)
    file.write_bytes(beginning + content[len(beginning) :])
    if refused:
        with pytest.raises(PictureError, match=refused):
            read(file)
    else:
        np.testing.assert_allclose(read(file).linear, linear_of(GREY), atol=0.005)


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "group3", "group4", "tiff_adobe_deflate", "packbits"])
def test_one_bit_pictures_of_faxes_are_read(tmp_path: Path, compression: str | None) -> None:
    Image.fromarray(GREY > 0.5).save(tmp_path / "a.tif", compression=compression)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif") > 0, GREY > 0.5)
    np.testing.assert_allclose(read(tmp_path / "a.tif").linear, GREY > 0.5)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_tiff_is_upright(tmp_path: Path, kind: str, orientation: int) -> None:
    turns = {
        1: lambda a: a, 2: np.fliplr, 3: lambda a: np.rot90(a, 2), 4: np.flipud, 5: lambda a: a.T,
        6: lambda a: np.rot90(a, 1), 7: lambda a: np.rot90(a, 2).T, 8: lambda a: np.rot90(a, -1),
    }  # fmt: skip
    turned = np.ascontiguousarray(turns[orientation](stored(GREY, kind)))
    tags = [(274, 3, 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", turned, metadata=None, photometric="minisblack", extratags=tags)
    np.testing.assert_allclose(read(tmp_path / "a.tif").linear, light_of(kind, GREY), atol=0.005)


def test_of_several_pages_the_first_is_read_and_that_is_said(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for page in (GREY, GREY[::-1]):
            writer.write(stored(page, "uint16"), photometric="minisblack")
    picture = read(tmp_path / "a.tif")
    np.testing.assert_allclose(picture.linear, linear_of(GREY), atol=0.005)
    assert ["more than one picture" in str(words) for words in picture.warnings] == [True]


@pytest.mark.parametrize(
    ("kind", "most", "words"),
    [
        ("uint16", 255, "8 bits"), ("uint16", 1023, "10 bits"), ("uint16", 4095, "12 bits"),
        ("uint16", 16383, "14 bits"),
        ("int16", 4095, "12 bits"), ("int32", 255, "8 bits"),
        ("int32", 65535, "16 bits"), ("uint32", 4095, "12 bits"),
        ("uint16", 65535, None), ("int16", 32767, None), ("int32", 2**31 - 1, None), ("uint32", 2**32 - 1, None),
    ],
)  # fmt: skip
def test_few_bits_in_many_keep_their_tones_and_that_is_said(
    tmp_path: Path, kind: str, most: int, words: str | None
) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.round(GREY * most).astype(kind), photometric="minisblack")
    picture = read(tmp_path / "a.tif")
    np.testing.assert_allclose(picture.linear, linear_of(GREY), atol=0.005)
    assert [words in str(one) for one in picture.warnings] == ([True] if words else [])


@pytest.mark.parametrize("kind", ["int16", "int32"])
def test_values_below_zero_are_refused(tmp_path: Path, kind: str) -> None:
    tifffile.imwrite(tmp_path / "a.tif", (stored(GREY, kind) - 20), photometric="minisblack")
    with pytest.raises(PictureError, match="negative"):
        read(tmp_path / "a.tif")


def test_the_server_refuses_the_same_layouts_at_once(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a", stored(GREY, "int8"), photometric="minisblack")
    checker = PictureChecker()
    try:
        with pytest.raises(PictureError, match="this TIFF stores BlackIsZero, 1 x 8 bit signed"):
            checker.check(tmp_path / "a", "a.tif", 40_000_000)
    finally:
        checker.close()
