"""Restricts the decoder's input from PNG and TIFF files: only the chunks of a PNG that describe its pixels, and only
known layouts of TIFF. Any other layout is refused by name before anything is decoded.

Pillow keeps all text of a PNG in memory and considers a file with long notes damaged. The colour profile is also
extracted here, with its own size limit. Pillow opens more layouts of TIFF than it reads correctly: for some it returns
wrong tones without an error (16 bits with 0 = white, signed bytes, compressed big-endian samples). So a table lists the
layouts that were compared with another decoder, tifffile (tests/service/job/picture/test_tiff_layouts.py), and only
those are read.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from PIL.TiffImagePlugin import PREFIXES, ImageFileDirectory_v2

from phrases.phrase import Phrase
from service.errors import PictureError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_KEPT = {b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"gAMA", b"cHRM", b"sRGB", b"eXIf"}
_PROFILE_BYTES = 16_000_000  # many times a table of three colours; LittleCMS reads it in a limited process
_NOTE_BYTES = 1_000_000  # of a chunk that is read whole: no camera's EXIF note is longer than 64 kB
_MOST_PARTS = 1000  # each read searches all of them
_SRGB_CODES = (1, 13, 0, 1)  # primaries, curve, matrix, full range (ITU-T H.273)


@dataclass(slots=True)
class PngChunks:
    """parts: (offset, bytes) of the file that the decoder reads. profile: ICC, b"" if there is a broken one."""

    parts: list[tuple[int, int]] = field(default_factory=list)
    profile: bytes | None = None
    is_srgb: bool = False

    def keep(self, offset: int, length: int) -> None:
        """Add a part; parts that touch are one."""
        if self.parts and sum(self.parts[-1]) == offset:
            start, before = self.parts.pop()
            offset, length = start, before + length
        self.parts.append((offset, length))


def find_chunks(file: BinaryIO, name: str) -> PngChunks | None:
    """Return the parts of a PNG to decode; None for another file. PictureError for unsupported colours.

    Where the sequence of chunks is broken, the decoder gets the whole rest of the file, and reports the damage.
    """
    file.seek(0)
    if file.read(len(_SIGNATURE)) != _SIGNATURE:
        file.seek(0)
        return None
    end = file.seek(0, io.SEEK_END)
    chunks, at = PngChunks([(0, len(_SIGNATURE))]), len(_SIGNATURE)
    while at + 12 <= end and len(chunks.parts) < _MOST_PARTS:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        if at + 12 + length > end or not kind.isalpha():
            break
        if kind == b"iCCP" and chunks.profile is None:
            chunks.profile = _read_profile(file.read(min(length, _PROFILE_BYTES)))
        elif kind == b"cICP":
            _require_srgb(file.read(min(length, 4)), name)
            chunks.is_srgb = True
        elif kind in _KEPT and (kind != b"eXIf" or length <= _NOTE_BYTES):
            chunks.keep(at, 12 + length)
        at += 12 + length
        if kind == b"IEND":
            return chunks
    chunks.keep(at, end - at)
    return chunks


def _read_profile(chunk: bytes) -> bytes:
    _, _, rest = chunk.partition(b"\0")
    inflate = zlib.decompressobj()
    try:
        profile = inflate.decompress(rest[1:], _PROFILE_BYTES)
    except zlib.error:
        return b""
    return profile if inflate.eof and rest[:1] == b"\0" else b""


def _require_srgb(code: bytes, name: str) -> None:
    if tuple(code) != _SRGB_CODES:
        words = Phrase(
            "{name}: this PNG stores wide or high dynamic range colours (cICP {code}), which are not read; save it as "
            "a PNG in sRGB",
            name=name,
            code=", ".join(map(str, code)),
        )
        raise PictureError(words)


class PartsOfFile(io.RawIOBase):
    """Parts of a file, joined to a readable file; nothing is kept in memory."""

    def __init__(self, file: BinaryIO, parts: list[tuple[int, int]]) -> None:
        self._file = file
        self._parts: list[tuple[int, int, int]] = []  # its start here, its start in the file, its length
        self._size = self._at = 0
        for offset, length in parts:
            self._parts.append((self._size, offset, length))
            self._size += length

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, origin: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[origin]
        self._at = max(0, base + offset)
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        for begin, start, length in self._parts:
            if begin <= self._at < begin + length:
                self._file.seek(start + self._at - begin)
                piece = self._file.read(min(len(buffer), begin + length - self._at))
                buffer[: len(piece)] = piece
                self._at += len(piece)
                return len(piece)
        return 0


_BIG_ENDIAN_BIGTIFF = b"MM\0+"  # Pillow mistakes its head for that of a small TIFF
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _CMYK, _YCBCR = 0, 1, 2, 3, 5, 6
_UINT, _INT, _FLOAT = 1, 2, 3
_RAW, _JPEG = 1, 7
_FAX = {2, 3, 4}
_LOSSLESS = {5, 8, 32946, 34925, 50000}  # LZW, deflate twice, LZMA, Zstandard: those that know predictors
_PACK_BITS = 32773

_NONE: tuple[int, ...] = ()
_ALPHA = {_NONE, (0,), (1,), (2,)}  # none, or one more sample: no alpha, premultiplied, plain
_SAMPLES: dict[tuple[int, int, int], set[tuple[int, ...]]] = {
    **{(_WHITE_IS_ZERO, _UINT, bits): {_NONE} for bits in (1, 2, 4, 8, 16)},
    **{(_BLACK_IS_ZERO, _UINT, bits): {_NONE} for bits in (1, 2, 4, 12, 16, 32)},
    (_BLACK_IS_ZERO, _UINT, 8): _ALPHA,
    (_BLACK_IS_ZERO, _INT, 16): {_NONE},
    (_BLACK_IS_ZERO, _INT, 32): {_NONE},
    (_BLACK_IS_ZERO, _FLOAT, 32): {_NONE},
    (_RGB, _UINT, 8): _ALPHA,
    (_RGB, _UINT, 16): _ALPHA,
    **{(_PALETTE, _UINT, bits): {_NONE} for bits in (1, 2, 4, 8)},
    (_CMYK, _UINT, 8): {_NONE},
    (_YCBCR, _UINT, 8): {_NONE},
}
_COLOURS = {_RGB: 3, _CMYK: 4, _YCBCR: 3}
_PHOTOMETRIC = {
    0: "WhiteIsZero", 1: "BlackIsZero", 2: "RGB", 3: "palette", 4: "mask", 5: "CMYK", 6: "YCbCr", 8: "CIELab",
    9: "ICCLab", 10: "ITULab", 32803: "CFA", 32844: "LogL", 32845: "LogLuv", 34892: "LinearRaw",
}  # fmt: skip
_FORMAT = {1: "unsigned", 2: "signed", 3: "floating point", 5: "complex", 6: "complex"}
_COMPRESSION = {
    1: "uncompressed", 2: "CCITT", 3: "CCITT group 3", 4: "CCITT group 4", 5: "LZW", 6: "old JPEG", 7: "JPEG",
    8: "deflate", 32773: "PackBits", 32809: "ThunderScan", 32946: "deflate", 33003: "JPEG 2000", 33005: "JPEG 2000",
    34676: "SGILog", 34677: "SGILog24", 34712: "JPEG 2000", 34887: "LERC", 34925: "LZMA", 50000: "Zstandard",
    50001: "WebP", 50002: "JPEG XL",
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class TiffLayout:
    """How the first picture of a TIFF stores its samples; numbers as in TIFF 6.0. bits: 0 where samples differ."""

    big_endian: bool
    photometric: int
    format: int
    bits: int
    samples: int
    extra: tuple[int, ...]
    separate: bool
    fill_order: int
    compression: int
    predictor: int
    has_more_pages: bool

    @property
    def white_is_zero(self) -> bool:
        """Return whether 0 is white and Pillow leaves inverting the samples to its caller."""
        return self.photometric == _WHITE_IS_ZERO and self.bits > 8

    @property
    def full_scale(self) -> int:
        """Return the largest value that a sample can hold."""
        return int(2 ** (self.bits - 1 if self.format == _INT else self.bits) - 1)

    @property
    def is_unsigned_32(self) -> bool:
        return self.format == _UINT and self.bits == 32

    @property
    def is_read(self) -> bool:
        return (
            self.extra in _SAMPLES.get((self.photometric, self.format, self.bits), ())
            and self.samples == _COLOURS.get(self.photometric, 1) + len(self.extra)
            and self._is_compression_read
            and self._is_order_read
        )

    @property
    def _is_compression_read(self) -> bool:
        if self.photometric == _YCBCR or self.compression == _JPEG:
            kinds = (_BLACK_IS_ZERO, _RGB, _YCBCR)
            whole = self.bits == 8 and not self.extra and not self.separate and self.predictor == 1
            return self.compression == _JPEG and self.photometric in kinds and whole
        if self.compression in _FAX:
            return self.bits == 1 and self.photometric in (_WHITE_IS_ZERO, _BLACK_IS_ZERO) and self.predictor == 1
        if self.compression in (_RAW, _PACK_BITS):
            return self.predictor == 1 and (self.bits != 12 or self.compression == _RAW)
        wanted = 3 if self.format == _FLOAT else 2
        return self.compression in _LOSSLESS and self.bits != 12 and self.predictor in (1, wanted)

    @property
    def _is_order_read(self) -> bool:
        """Return whether Pillow reads this order of bits, bytes and planes."""
        if self.fill_order != 1 and (self.fill_order != 2 or self.bits != 1):
            return False
        if self.separate and self.photometric != _RGB:
            return False
        if self.separate and self.compression == _RAW and (self.bits != 8 or self.extra):
            return False
        if not self.big_endian or self.bits <= 8 or self.photometric == _RGB:
            return True
        if self.format == _UINT:
            return self.bits == 16 and self.photometric == _BLACK_IS_ZERO
        return self.compression == _RAW

    def __str__(self) -> str:
        words = [
            _PHOTOMETRIC.get(self.photometric, f"photometric {self.photometric}"),
            f"{self.samples} x {self.bits} bit {_FORMAT.get(self.format, f'sample format {self.format}')}",
            _COMPRESSION.get(self.compression, f"compression {self.compression}"),
        ]
        words += [f"extra samples {', '.join(map(str, self.extra))}"] if self.extra else []
        words += [f"predictor {self.predictor}"] if self.predictor != 1 else []
        words += ["separate planes"] if self.separate else []
        words += ["fill order 2"] if self.fill_order != 1 else []
        words += ["big-endian"] if self.big_endian else []
        return ", ".join(words)


def require_known_layout(file: BinaryIO, name: str) -> TiffLayout | None:
    """Return the layout of a supported TIFF, None for a file that is not a TIFF; PictureError for other layouts.

    The file is left at its start. If the directory is damaged, Pillow's own error is raised.
    """
    file.seek(0)
    head = file.read(16)
    file.seek(0)
    if head[:4] not in PREFIXES:
        return None
    if head.startswith(_BIG_ENDIAN_BIGTIFF):
        raise _make_refusal(name, "BigTIFF, big-endian")
    tags = ImageFileDirectory_v2(head if head[2] == 43 else head[:8])  # a BigTIFF has the longer head
    file.seek(tags.next)
    tags.load(file)
    layout = _read_layout(tags, big_endian=head[:2] == b"MM")
    file.seek(0)
    if _read_first(tags, 254, 0) & 1:
        words = Phrase("{name}: the first picture of this TIFF is a preview; save the picture alone as PNG", name=name)
        raise PictureError(words)
    odd = _odd_colours(tags, layout)
    if odd or not layout.is_read:
        raise _make_refusal(name, f"{layout}{odd}")
    return layout


def _make_refusal(name: str, layout: str) -> PictureError:
    return PictureError(
        Phrase(
            "{name}: this TIFF stores {layout}, which is not read; save it as PNG, grey or RGB of 8 or 16 bits",
            name=name,
            layout=layout,
        )
    )


def _read_layout(tags: ImageFileDirectory_v2, *, big_endian: bool) -> TiffLayout:
    bits, formats = _read_all(tags, 258, (1,)), _read_all(tags, 339, (_UINT,))
    samples = _read_first(tags, 277, 1)
    alike = len(set(bits)) == 1 and len(bits) in (1, samples)
    return TiffLayout(
        big_endian=big_endian,
        photometric=_read_first(tags, 262, -1),
        format=formats[0] if len(set(formats)) == 1 else -1,
        bits=bits[0] if alike else 0,
        samples=samples,
        extra=_read_all(tags, 338, ()),
        separate=samples > 1 and _read_first(tags, 284, 1) != 1,
        fill_order=_read_first(tags, 266, 1),
        compression=_read_first(tags, 259, _RAW),
        predictor=_read_first(tags, 317, 1),
        has_more_pages=bool(tags.next),
    )


def _odd_colours(tags: ImageFileDirectory_v2, layout: TiffLayout) -> str:
    """Return a name for inks other than CMYK, or for a palette of 8 bits instead of 16; "" otherwise."""
    if layout.photometric == _CMYK and _read_first(tags, 332, 1) != 1:
        return ", other inks"
    if layout.photometric == _PALETTE and 0 < max(_read_all(tags, 320, (0,))) <= 255:
        return ", its colours with 8 bits"
    return ""


def _read_all(tags: ImageFileDirectory_v2, tag: int, default: tuple[int, ...]) -> tuple[int, ...]:
    value: Any = tags.get(tag, default)
    return tuple(int(one) for one in value) if isinstance(value, tuple) else (int(value),)


def _read_first(tags: ImageFileDirectory_v2, tag: int, default: int) -> int:
    return _read_all(tags, tag, (default,))[0]
