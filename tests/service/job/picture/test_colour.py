"""Profiles, gammas and primaries: the light on the wall is that of what a viewer shows, as LittleCMS shows it."""

from __future__ import annotations

import io
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms

from service.job.picture.decoding import _ADOBE_RGB, _SRGB, Colorimetry
from service.job.picture.linear_light import _make_profile, _pack_curve, _pack_profile
from service.job.picture.reading import Picture, read_picture, read_wall_photo
from service.job.spec.model import ImageSpec
from tests.service.job.picture.samples import SHARES, Array, linear_of

SIDE = 64
RAMP = np.arange(SIDE * SIDE).reshape(SIDE, SIDE) / (SIDE * SIDE - 1)
COLOURS = np.random.default_rng(3).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
P3 = Colorimetry(gamma=2.4, white=(0.3127, 0.3290), red=(0.680, 0.320), green=(0.265, 0.690), blue=(0.150, 0.060))
LINEAR = Colorimetry(gamma=1.0, white=_SRGB.white, red=_SRGB.red, green=_SRGB.green, blue=_SRGB.blue)
PROFILES = {"Adobe RGB": _ADOBE_RGB, "P3": P3, "linear": LINEAR, "gamma 1.8": Colorimetry(
    gamma=1.8, white=(0.3457, 0.3585), red=(0.7347, 0.2653), green=(0.1596, 0.8404), blue=(0.0366, 0.0001)
)}  # fmt: skip


def light_of(image: Image.Image) -> Array:
    return np.asarray(linear_of(np.asarray(image.convert("RGB")) / 255.0) @ SHARES)


def as_seen(image: Image.Image, profile: bytes) -> Array:
    """What a viewer shows, as light: LittleCMS to sRGB of 8 bits."""
    opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    shown = ImageCms.profileToProfile(image, opened, ImageCms.createProfile("sRGB"), outputMode="RGB")
    assert shown is not None
    return light_of(shown)


def misplaced(light: Array, wanted: Array) -> float:
    return float(np.abs(light / light.mean() - wanted / wanted.mean()).sum() / 2 / wanted.size)


def read(path: Path, side: int = SIDE, **settings: Any) -> Picture:
    return read_picture(path, ImageSpec(pixels=side, **settings), rows=side, aspect=1.0)


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("kind", ["PNG", "TIFF", "WEBP", "JPEG"])
def test_a_profile_gives_the_light_of_what_is_seen(tmp_path: Path, name: str, kind: str) -> None:
    profile = _make_profile(PROFILES[name], grey=False)
    options: dict[str, Any] = {"WEBP": {"lossless": True}, "JPEG": {"quality": 100}}.get(kind, {})
    path = tmp_path / "a.file"
    Image.fromarray(COLOURS).save(path, kind, icc_profile=profile, **options)
    with Image.open(path) as stored:
        wanted = as_seen(stored.convert("RGB"), profile)
        assert misplaced(light_of(stored), wanted) > 0.01, "or this test shows nothing"
    np.testing.assert_allclose(read(path).linear, wanted, atol=1e-9)
    assert read_wall_photo(path).light.mean() >= wanted.mean() - 1e-9  # of which clipped colours count as white


@pytest.mark.parametrize("mode", ["RGBA", "P", "CMYK"])
def test_a_profile_is_used_in_every_mode_of_colour(tmp_path: Path, mode: str) -> None:
    profile = _make_profile(LINEAR, grey=False)
    image = Image.fromarray(COLOURS).quantize(64) if mode == "P" else Image.fromarray(COLOURS).convert(mode)
    if mode == "RGBA":
        image.putalpha(128)
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    image.save(path, icc_profile=profile)
    picture = read(path)
    if mode == "CMYK":  # the profile is of another kind
        np.testing.assert_allclose(picture.linear, light_of(image), atol=1e-9)
        assert "another kind" in str(picture.warnings[0])
        return
    wanted = as_seen(image.convert("RGB"), profile)
    opacity = 128 / 255 if mode == "RGBA" else 1.0
    np.testing.assert_allclose(picture.linear, opacity * wanted + 1 - opacity, atol=1e-9)
    assert not picture.warnings


@settings(max_examples=25, deadline=None)
@given(st.floats(1.0, 3.0), st.sampled_from(["L", "LA", "I;16"]), st.booleans())
def test_grey_pictures_keep_every_bit(gamma: float, mode: str, grey_profile: bool) -> None:
    """Their profile may be one for grey or, as converters leave it, the one of the colours they had."""
    gamma = round(gamma * 65536) / 65536
    profile = _make_profile(Colorimetry(**{**_fields(_SRGB), "gamma": gamma}), grey=grey_profile)
    most = 65535 if mode == "I;16" else 255
    values = np.round(RAMP * most).astype(np.uint16 if mode == "I;16" else np.uint8)
    image = Image.fromarray(values)
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        (image.convert("LA") if mode == "LA" else image).save(file, "PNG", icc_profile=profile)
        file.flush()
        found = read(Path(file.name)).linear
    wanted = (values / most) ** gamma
    np.testing.assert_allclose(found, wanted, atol=2e-4)
    np.testing.assert_allclose(found, wanted, rtol=0.012 if grey_profile else 0.05, atol=1e-4)


def _fields(colour: Colorimetry) -> dict[str, Any]:
    return {name: getattr(colour, name) for name in ("gamma", "white", "red", "green", "blue")}


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def with_chunks(image: Image.Image, *chunks: bytes) -> bytes:
    """The PNG with chunks after its header."""
    with io.BytesIO() as file:
        image.save(file, "PNG")
        content = file.getvalue()
    return content[:33] + b"".join(chunks) + content[33:]


def gama(gamma: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(100000 / gamma)))


def chrm(colour: Colorimetry) -> bytes:
    points = (*colour.white, *colour.red, *colour.green, *colour.blue)
    return chunk(b"cHRM", struct.pack(">8I", *(round(100000 * one) for one in points)))


SRGB_CHUNK = chunk(b"sRGB", b"\0")


@pytest.mark.parametrize(
    ("chunks", "gamma"),
    [
        ((gama(1.0),), 1.0), ((gama(1.8),), 1.8), ((gama(2.2),), None), ((), None), ((gama(1.0), SRGB_CHUNK), None),
        ((chunk(b"gAMA", bytes(4)),), None), ((gama(1000.0),), None), ((chrm(P3),), None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("mode", ["L", "I;16", "RGB"])
def test_a_gamma_is_obeyed_unless_srgb_is_named(
    tmp_path: Path, mode: str, chunks: tuple[bytes, ...], gamma: float | None
) -> None:
    values = np.round(RAMP * 65535).astype(np.uint16) if mode == "I;16" else np.round(RAMP * 255).astype(np.uint8)
    image = Image.fromarray(values)
    (tmp_path / "a.png").write_bytes(with_chunks(image.convert("RGB") if mode == "RGB" else image, *chunks))
    tones = values / values.max()
    wanted = linear_of(tones) if gamma is None else tones**gamma
    np.testing.assert_allclose(read(tmp_path / "a.png").linear, wanted, atol=0.005 if mode == "RGB" else 1e-4)


def test_primaries_are_obeyed_with_their_gamma(tmp_path: Path) -> None:
    image = Image.fromarray(COLOURS)
    (tmp_path / "a.png").write_bytes(with_chunks(image, gama(_ADOBE_RGB.gamma), chrm(_ADOBE_RGB)))
    wanted = as_seen(image, _make_profile(_ADOBE_RGB, grey=False))
    np.testing.assert_allclose(read(tmp_path / "a.png").linear, wanted, atol=0.006)  # 5 digits of a chunk


def test_a_profile_counts_for_more_than_a_gamma(tmp_path: Path) -> None:
    profile = _make_profile(P3, grey=False)
    image = Image.fromarray(COLOURS)
    named = chunk(b"iCCP", b"p\0\0" + zlib.compress(profile))
    (tmp_path / "a.png").write_bytes(with_chunks(image, gama(1.0), chrm(_ADOBE_RGB), named))
    np.testing.assert_allclose(read(tmp_path / "a.png").linear, as_seen(image, profile), atol=1e-9)


def test_a_note_of_a_camera_that_says_adobe_rgb_is_obeyed(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.fromarray(COLOURS).save(tmp_path / "a.jpg", quality=100, exif=exif)
    with Image.open(tmp_path / "a.jpg") as stored:
        wanted = as_seen(stored.convert("RGB"), _make_profile(_ADOBE_RGB, grey=False))
    np.testing.assert_allclose(read(tmp_path / "a.jpg").linear, wanted, atol=1e-9)


@pytest.mark.parametrize("mode", ["L", "RGB"])
@pytest.mark.parametrize("cut", [0, 3, 100, 200, 300])
def test_a_broken_profile_is_said_and_srgb_taken(tmp_path: Path, mode: str, cut: int) -> None:
    whole = _make_profile(P3, grey=mode == "L")
    image = Image.fromarray(COLOURS).convert(mode)
    named = chunk(b"iCCP", b"p\0\0" + zlib.compress(whole[:cut]))
    (tmp_path / "a.png").write_bytes(with_chunks(image, named))
    picture = read(tmp_path / "a.png")
    if cut < 200:
        assert "taken as sRGB" in str(picture.warnings[0])
    if picture.warnings:
        np.testing.assert_allclose(picture.linear, light_of(image), atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 450), st.integers(0, 255)), max_size=6))
def test_a_profile_with_changed_bytes_is_a_picture_or_a_line(changes: list[tuple[int, int]]) -> None:
    from service.job.picture.decoding import DecodedPicture
    from service.job.picture.linear_light import ProfileError, find_conversion

    profile = bytearray(_make_profile(P3, grey=False))
    for place, value in changes:
        profile[place % len(profile)] = value
    image = Image.fromarray(COLOURS[:16, :16])
    try:
        shown = find_conversion(DecodedPicture(image=image, colour=bytes(profile))).convert_colours(image)
    except ProfileError:
        return
    assert shown.mode == "RGB" and shown.size == image.size


def test_linear_tone_counts_for_more_than_the_profile_and_that_is_said(tmp_path: Path) -> None:
    image = Image.fromarray(COLOURS)
    image.save(tmp_path / "a.png", icc_profile=_make_profile(P3, grey=False))
    picture = read(tmp_path / "a.png", tone="linear")
    np.testing.assert_allclose(picture.linear, COLOURS / 255.0 @ SHARES, atol=1e-9)
    assert "image.tone = linear" in str(picture.warnings[0])


def test_an_srgb_profile_changes_nothing_that_is_seen(tmp_path: Path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    image = Image.fromarray(COLOURS)
    image.save(tmp_path / "a.png", icc_profile=profile)
    assert misplaced(read(tmp_path / "a.png").linear, light_of(image)) < 0.0005
    image.convert("L").save(tmp_path / "b.png", icc_profile=profile)
    np.testing.assert_allclose(read(tmp_path / "b.png").linear, light_of(image.convert("L")), atol=2e-4)


def test_a_grey_profile_on_a_colour_picture_is_of_another_kind(tmp_path: Path) -> None:
    Image.fromarray(COLOURS).save(
        tmp_path / "a.png", icc_profile=_pack_profile(b"GRAY", {b"kTRC": _pack_curve(0, 1.0)})
    )
    assert "another kind" in str(read(tmp_path / "a.png").warnings[0])
