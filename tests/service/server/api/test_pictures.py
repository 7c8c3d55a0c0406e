"""What a stranger uploads is decoded in a child that may die of it; the answer is facts or one sentence, always."""

from __future__ import annotations

import os
import random
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from service.errors import FailedError, PictureError
from service.job.picture import PictureFacts
from service.server.api.intake.child_requests import PictureChecker
from tests.service.server.api.server import encoded

ROOT = Path(__file__).parents[4]
MAX_PIXELS = 40_000_000
NAME = "my cat.png"


@pytest.fixture(scope="module")
def checker() -> Iterator[PictureChecker]:
    made = PictureChecker(time_limit_s=10.0)
    yield made
    made.close()


@pytest.fixture
def refused(checker: PictureChecker, tmp_path: Path):
    """The sentence that refuses some bytes; it never shows where the upload lies."""

    def sentence(data: bytes, max_pixels: int = MAX_PIXELS) -> str:
        path = tmp_path / "upload-7"
        path.write_bytes(data)
        with pytest.raises(PictureError) as caught:
            checker.check(path, NAME, max_pixels)
        words = str(caught.value)
        assert words.startswith(f"{NAME}: ") and "upload-7" not in words and "\n" not in words
        return words

    return sentence


@pytest.fixture
def facts(checker: PictureChecker, tmp_path: Path):
    def found(data: bytes) -> PictureFacts:
        path = tmp_path / "upload-7"
        path.write_bytes(data)
        return checker.check(path, NAME, MAX_PIXELS)

    return found


def noise(mode: str = "RGB", side: int = 64) -> Image.Image:
    return Image.frombytes(
        mode, (side, side), random.Random(1).randbytes(side * side * len(Image.new(mode, (1, 1)).tobytes()))
    )


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, rows: bytes, *extra: bytes) -> bytes:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(extra) + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b"")


def pid_of(checker: PictureChecker) -> int:
    assert checker.child_pid is not None
    return checker.child_pid


# --- what can be used ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "mode"),
    [
        ("PNG", "L"), ("PNG", "RGB"), ("PNG", "RGBA"), ("PNG", "I;16"), ("PNG", "1"), ("PNG", "P"), ("JPEG", "RGB"),
        ("JPEG", "CMYK"), ("JPEG", "L"), ("TIFF", "RGB"), ("TIFF", "F"), ("TIFF", "I;16"), ("WEBP", "RGB"),
        ("BMP", "RGB"), ("GIF", "L"),
    ],
)  # fmt: skip
def test_pictures_of_the_named_formats_pass(facts, kind: str, mode: str) -> None:
    picture = noise("L").convert(mode) if mode in ("1", "P", "F") else noise(mode)
    assert facts(encoded(picture, kind)) == PictureFacts(width=64, height=64, format=kind, mode=mode)


def test_the_first_frame_of_an_animation_passes(facts) -> None:
    frames = [noise("P"), noise("P").rotate(90)]
    for kind in ("GIF", "WEBP", "PNG", "TIFF"):
        assert facts(encoded(frames[0], kind, save_all=True, append_images=frames[1:])).format == kind


def test_the_content_says_what_it_is_and_not_the_name(checker: PictureChecker, tmp_path: Path) -> None:
    path = tmp_path / "upload.fits"
    path.write_bytes(encoded(noise(), "JPEG"))
    assert checker.check(path, "lens.svg", MAX_PIXELS).format == "JPEG"


def test_what_passes_here_passes_in_the_image_stage(facts, tmp_path: Path) -> None:
    """One implementation decodes in both places: also an upright turn by EXIF, and a note too long to be kept."""
    from service.job.picture import OWN_PICTURE
    from service.job.picture.decoding import decode_picture

    exif = Image.Exif()
    exif[0x0112] = 6
    data = encoded(noise("RGB").crop((0, 0, 64, 32)), "JPEG", exif=exif)
    found = facts(data)
    assert (found.width, found.height) == (64, 32)
    (tmp_path / "again").write_bytes(data)
    assert decode_picture(tmp_path / "again", OWN_PICTURE, "again").image.size == (32, 64)


# --- what cannot ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF"])
def test_a_picture_cut_short_is_refused(checker: PictureChecker, tmp_path: Path, kind: str) -> None:
    """Or it has all its pixels: the last bytes of some formats carry none."""
    whole, path = encoded(noise(), kind), tmp_path / "cut"
    (tmp_path / "whole").write_bytes(whole)
    full = Image.open(tmp_path / "whole").convert("RGB").tobytes()
    generator, passed = random.Random(kind), 0
    for length in [generator.randrange(len(whole)) for _ in range(50)]:
        path.write_bytes(whole[:length])
        try:
            checker.check(path, NAME, MAX_PIXELS)
        except PictureError:
            continue
        passed += 1
        assert Image.open(path).convert("RGB").tobytes() == full
    assert passed <= 2


@pytest.mark.parametrize(
    "data",
    [
        b"just some words, no picture",
        b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg" width="100" height="100"/>',
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n(/etc/passwd) run\n",
        b"%PDF-1.7\n1 0 obj\n<<>>\nendobj\n",
        b"\x00\x00\x01\x00\x01\x00\x10\x10\x00\x00",  # an icon
        b"P6 64 64 255\n" + bytes(64 * 64 * 3),  # a pixmap
        b"SIMPLE  =                    T" + bytes(2880),
        b"PK\x03\x04" + bytes(100),
        b"\x7fELF" + bytes(100),
        bytes(1000),
        b"%PDF-1.7\n" + encoded(Image.new("RGB", (64, 64)), "PNG"),  # two things at once
        b'<svg xmlns="http://www.w3.org/2000/svg"/>\n' + encoded(Image.new("RGB", (64, 64)), "JPEG"),
    ],
)
def test_what_is_no_picture_of_these_formats_is_refused(refused, data: bytes) -> None:
    assert refused(data) == f"{NAME}: not a picture that can be read (PNG, JPEG, TIFF, WebP, BMP, GIF can)"


def test_an_empty_file_is_refused(refused) -> None:
    assert refused(b"") == f"{NAME}: the file is empty"


def test_a_missing_file_is_told_by_the_picture_s_name(checker: PictureChecker, tmp_path: Path) -> None:
    with pytest.raises(PictureError, match=r"my cat\.png: there is no such file"):
        checker.check(tmp_path / "nothing", NAME, MAX_PIXELS)


@pytest.mark.parametrize("name", ["a\nb.png", "\x1b[2J", "ü" * 3000, "../../etc/passwd", '"}', "\ud800"])
def test_any_name_comes_back_on_one_line(checker: PictureChecker, tmp_path: Path, name: str) -> None:
    with pytest.raises(PictureError) as caught:
        checker.check(tmp_path / "nothing", name, MAX_PIXELS)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("side", [6400, 20_000, 100_000, 2_000_000_000])
def test_a_header_that_promises_too_much_is_refused_before_decoding(refused, side: int) -> None:
    begun = time.monotonic()
    assert "allowed: at most 40000000" in refused(png(side, side, zlib.compress(bytes(1000))))
    assert time.monotonic() - begun < 5.0


def test_a_bomb_within_the_limit_of_pixels_is_decoded_in_the_child(checker: PictureChecker, tmp_path: Path) -> None:
    side = 6300
    path = tmp_path / "bomb.png"
    path.write_bytes(png(side, side, zlib.compress(bytes((side + 1) * side), 9)))
    assert path.stat().st_size < 60_000
    assert checker.check(path, NAME, MAX_PIXELS).width == side
    assert resident_mb(pid_of(checker)) < 60


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_bombs_in_the_notes_of_a_png_do_no_harm(facts) -> None:
    rows = zlib.compress(bytes(65 * 64))
    flood = zlib.compress(bytes(60_000_000), 9)
    for kind in (b"zTXt", b"iCCP"):
        assert facts(png(64, 64, rows, png_chunk(kind, b"k\0\0" + flood))).format == "PNG"
    notes = [png_chunk(b"tEXt", b"k%d\0" % number + bytes(900_000)) for number in range(80)]
    assert facts(png(64, 64, rows, *notes)).format == "PNG"


def test_a_tiff_whose_directories_form_a_circle_is_answered(facts) -> None:
    data = bytearray(encoded(noise("L"), "TIFF"))
    (start,) = struct.unpack("<I", data[4:8])
    (count,) = struct.unpack("<H", data[start : start + 2])
    data[start + 2 + 12 * count :][:4] = b""
    data[start + 2 + 12 * count : start + 6 + 12 * count] = struct.pack("<I", start)
    assert facts(bytes(data)).format == "TIFF"


def test_changed_bytes_end_in_facts_or_in_a_sentence(checker: PictureChecker, tmp_path: Path) -> None:
    generator, path = random.Random(7), tmp_path / "changed"
    for kind in ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF"):
        whole = encoded(noise(), kind)
        for _ in range(40):
            data = bytearray(whole)
            for _ in range(generator.randrange(1, 8)):
                data[generator.randrange(min(len(data), 400))] = generator.randrange(256)
            path.write_bytes(data)
            try:
                assert checker.check(path, NAME, MAX_PIXELS).width > 0
            except PictureError as error:
                assert str(error).startswith(f"{NAME}: ") and "\n" not in str(error)


@pytest.mark.parametrize("size", [(7, 64), (64, 7), (1, 1)])
def test_a_picture_too_small_for_a_lens_is_refused(refused, size: tuple[int, int]) -> None:
    assert "allowed: at least 8 x 8" in refused(encoded(Image.new("L", size), "PNG"))


# --- the child -----------------------------------------------------------------------------------------------------


def test_a_child_that_was_killed_is_replaced(checker: PictureChecker, tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(encoded(noise(), "PNG"))
    checker.check(path, NAME, MAX_PIXELS)
    os.kill(pid_of(checker), signal.SIGKILL)
    assert checker.check(path, NAME, MAX_PIXELS).format == "PNG"


def test_a_picture_that_takes_too_long_is_refused_and_the_next_one_works(tmp_path: Path) -> None:
    """A frozen child stands for a decoder without end."""
    checker = PictureChecker(time_limit_s=0.5)
    path = tmp_path / "picture.png"
    path.write_bytes(encoded(noise(), "PNG"))
    checker.check(path, NAME, MAX_PIXELS)
    os.kill(frozen := pid_of(checker), signal.SIGSTOP)
    with pytest.raises(PictureError, match=r"my cat.png: takes longer than 0.5 s to decode"):
        checker.check(path, NAME, MAX_PIXELS)
    assert checker.check(path, NAME, MAX_PIXELS).format == "PNG"
    assert pid_of(checker) != frozen
    checker.close()


def test_a_closed_checker_says_so_and_leaves_no_process(tmp_path: Path) -> None:
    checker = PictureChecker()
    (tmp_path / "picture.png").write_bytes(encoded(noise(), "PNG"))
    checker.check(tmp_path / "picture.png", NAME, MAX_PIXELS)
    pid = pid_of(checker)
    checker.close()
    assert not Path(f"/proc/{pid}").exists()
    with pytest.raises(FailedError, match="shutting down"):
        checker.check(tmp_path / "picture.png", NAME, MAX_PIXELS)


def test_the_child_imports_no_arrays_and_few_decoders() -> None:
    module = "service.server.api.intake.picture_child"
    code = f"import sys, {module}, PIL.Image; print('numpy' in sys.modules, sorted(PIL.Image.OPEN))"
    said = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.strip() == "False ['BMP', 'DIB', 'GIF', 'JPEG', 'PNG', 'TIFF', 'WEBP']"


def test_a_checker_that_is_closed_does_not_wait_for_its_process_to_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy computer that may take many seconds, which the end of the server would take, too."""
    slow = tmp_path / "python"
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    slow.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(slow))
    checker = PictureChecker()
    began = time.monotonic()
    checker.close()
    assert time.monotonic() - began < 5
