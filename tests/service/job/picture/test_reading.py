"""Any picture Pillow reads becomes the right linear light, upright; what cannot be used is one line, told early. A
measured picture of the light becomes rows of strength from rim to rim.

A picture that looks the same in no mirror is followed all the way to the eye of the viewer: the light is traced here by
Snell's law written out once more, and the viewer is described by where they stand, so that neither the forward model
nor the one flipping function is taken at its word.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from optics.heightfield import Heightfield
from service.cli.main import run
from service.client.submit import spec_text
from service.errors import PictureError, ServiceError
from service.job.arrays import load_heightfield
from service.job.picture.linear_light import linear_to_srgb, srgb_to_linear
from service.job.picture.reading import Picture, light_rows, read_picture
from service.job.picture.resampling import Span, weights_to_resample
from service.job.spec.loading import resolve_spec
from service.job.spec.model import ImageSpec

RED, GREEN, BLUE = 0.2126, 0.7152, 0.0722

SIDE_MM, THROW_MM, INDEX = 20.0, 40.0, 1.49


def linear_of(level: float) -> float:
    """The sRGB curve written out once more, level in [0, 1]."""
    return level / 12.92 if level <= 0.04045 else ((level + 0.055) / 1.055) ** 2.4


def read(path: Path, *, pixels: int = 16, rows: int = 16, aspect: float = 1.0, **settings: object) -> Picture:
    return read_picture(path, ImageSpec(pixels=pixels, **settings), rows=rows, aspect=aspect)  # type: ignore[arg-type]


def saved(image: Image.Image, path: Path, **options: object) -> Path:
    image.save(path, **options)  # type: ignore[arg-type]
    return path


@pytest.mark.parametrize(
    ("mode", "colour", "expected"),
    [
        ("L", 127, linear_of(127 / 255)),
        ("RGB", (255, 0, 0), RED),
        ("RGB", (0, 255, 0), GREEN),
        ("RGB", (0, 0, 255), BLUE),
        ("RGB", (200, 100, 50), RED * linear_of(200 / 255) + GREEN * linear_of(100 / 255) + BLUE * linear_of(50 / 255)),
        ("RGBA", (0, 0, 0, 51), 0.8),
        ("LA", (127, 255), linear_of(127 / 255)),
        ("LA", (0, 51), 0.8),
        ("1", 1, 1.0),
        ("I;16", 40000, linear_of(40000 / 65535)),
    ],
)
def test_one_colour_of_each_mode_has_its_known_luminance(
    tmp_path: Path, mode: str, colour: object, expected: float
) -> None:
    path = saved(Image.new(mode, (16, 16), colour), tmp_path / "a.png")  # type: ignore[arg-type]
    picture = read(path)
    assert picture.linear.shape == (16, 16)
    np.testing.assert_allclose(picture.linear, expected, atol=1e-12)
    assert picture.is_one_tone


@pytest.mark.parametrize(("level", "expected"), [(255, 1.0), (0, None), (51, 0.2)])
def test_linear_tone_takes_values_as_light(tmp_path: Path, level: int, expected: float | None) -> None:
    path = saved(Image.new("L", (16, 16), level), tmp_path / "a.png")
    if expected is None:
        with pytest.raises(PictureError, match="black everywhere"):
            read(path, tone="linear")
    else:
        np.testing.assert_allclose(read(path, tone="linear").linear, expected, atol=1e-12)


def test_cmyk_is_read_as_the_colour_it_prints(tmp_path: Path) -> None:
    path = saved(Image.new("CMYK", (16, 16), (0, 0, 0, 128)), tmp_path / "a.tif")
    np.testing.assert_allclose(read(path).linear, linear_of(127 / 255), atol=1e-12)


def test_palette_with_transparency_lies_over_white(tmp_path: Path) -> None:
    image = Image.new("P", (16, 16), 0)
    image.putpalette([0, 0, 0, 255, 255, 255, 0, 0, 0])
    image.putpixel((0, 0), 1)
    image.putpixel((1, 0), 2)
    path = saved(image, tmp_path / "a.gif", transparency=0)
    assert read(path).linear.sum() == pytest.approx(255.0)
    opaque = saved(image, tmp_path / "b.png")
    assert read(opaque).linear.sum() == pytest.approx(1.0)


def test_sixteen_bits_are_not_cut_to_eight(tmp_path: Path) -> None:
    values = np.arange(256, dtype=np.uint16).reshape(16, 16) + 30000  # less than two 8 bit steps
    path = saved(Image.fromarray(values), tmp_path / "a.png")
    np.testing.assert_allclose(read(path, tone="linear").linear, values / 65535, atol=1e-12)


def test_floating_point_pictures_are_linear_light(tmp_path: Path) -> None:
    values = np.linspace(0, 4, 256, dtype=np.float32).reshape(16, 16)
    path = saved(Image.fromarray(values), tmp_path / "a.tif")
    np.testing.assert_allclose(read(path).linear, values / 4, atol=1e-6)


def test_a_floating_point_picture_with_nan_is_refused(tmp_path: Path) -> None:
    path = saved(Image.fromarray(np.full((16, 16), np.nan, dtype=np.float32)), tmp_path / "a.tif")
    with pytest.raises(PictureError, match="not finite"):
        read(path)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_undone(tmp_path: Path, orientation: int) -> None:
    """A bright quadrant at the upper left is stored turned, with the note that undoes it."""
    upright = np.zeros((24, 32), dtype=np.uint8)
    upright[:12, :16] = 255
    turns = {
        1: lambda a: a, 2: np.fliplr, 3: lambda a: np.rot90(a, 2), 4: np.flipud, 5: lambda a: a.T,
        6: lambda a: np.rot90(a, 1), 7: lambda a: np.rot90(a, 2).T, 8: lambda a: np.rot90(a, -1),
    }  # fmt: skip
    image = Image.fromarray(np.ascontiguousarray(turns[orientation](upright)))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = saved(image, tmp_path / "a.png", exif=exif)
    picture = read(path, pixels=32, rows=24, aspect=32 / 24)
    np.testing.assert_allclose(picture.linear, upright / 255)


def test_an_animation_gives_its_first_frame(tmp_path: Path) -> None:
    frames = [Image.new("L", (16, 16), level) for level in (255, 10, 20)]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    np.testing.assert_allclose(read(tmp_path / "a.gif").linear, 1.0)


def test_invert_is_a_negative_in_the_picture_s_tones(tmp_path: Path) -> None:
    path = saved(Image.new("L", (16, 16), 200), tmp_path / "a.png")
    np.testing.assert_allclose(read(path, invert=True).linear, linear_of(55 / 255), atol=1e-9)
    np.testing.assert_allclose(read(path, invert=True, tone="linear").linear, 55 / 255, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.integers(16, 90), st.integers(16, 90), st.integers(0, 2**32 - 1))
def test_shrinking_keeps_the_mean_light(width: int, height: int, seed: int) -> None:
    """Stretched to fewer pixels, whatever the ratio, total light is exact: area averages, in linear light."""
    values = np.random.default_rng(seed).random((height, width))
    across, down = (weights_to_resample(n, Span(0, n), 16) for n in (width, height))
    assert (down @ values @ across.T).mean() == pytest.approx(values.mean(), rel=1e-12)
    np.testing.assert_allclose(across.sum(axis=1), 1.0)


@given(st.integers(8, 60), st.integers(61, 300))
def test_enlarging_keeps_constants_and_places(size: int, count: int) -> None:
    """Weights sum to 1, and a straight ramp stays one away from the edges (Catmull-Rom)."""
    weights = weights_to_resample(size, Span(0, size), count)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    centres = (np.arange(count) + 0.5) * size / count
    inner = (centres > 2) & (centres < size - 2)
    np.testing.assert_allclose((weights @ (np.arange(size) + 0.5))[inner], centres[inner], atol=1e-9)


def test_fit_crop_pad_and_stretch(tmp_path: Path) -> None:
    """A picture of 3 x 1 parts, black white black, on a square screen."""
    values = np.zeros((32, 96), dtype=np.uint8)
    values[:, 32:64] = 255
    path = saved(Image.fromarray(values), tmp_path / "a.png")
    np.testing.assert_allclose(read(path, fit="crop").linear, 1.0)
    stretched = read(path, fit="stretch").linear
    assert stretched.mean() == pytest.approx(1 / 3)
    assert (stretched[:, 0] == 0).all()
    padded = read(path, pixels=48, rows=48, fit="pad").linear
    assert padded.mean() == pytest.approx(1 / 9)
    np.testing.assert_allclose(padded[16:32, 16:32], 1.0)
    assert padded[:16].max() == 0


def test_light_is_averaged_not_tones(tmp_path: Path) -> None:
    """A checkerboard of black and white shrinks to half the light, which is sRGB level 188, not 128."""
    board = np.indices((64, 64)).sum(axis=0) % 2 * 255
    path = saved(Image.fromarray(board.astype(np.uint8)), tmp_path / "a.png")
    np.testing.assert_allclose(read(path).linear, 0.5, atol=1e-12)


@given(st.floats(0, 1))
def test_the_tone_curves_are_inverse(value: float) -> None:
    assert float(srgb_to_linear(linear_to_srgb(np.array(value)))) == pytest.approx(value, abs=1e-6)


def test_a_large_strip_wise_read_equals_a_whole_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(3).integers(0, 256, (50, 70, 4), dtype=np.uint8)
    path = saved(Image.fromarray(values), tmp_path / "a.png")
    whole = read(path).linear
    monkeypatch.setattr("service.job.picture.reading._STRIP_PIXELS", 70 * 7)
    np.testing.assert_allclose(read(path).linear, whole, atol=1e-12)


def huge_png(width: int, height: int) -> bytes:
    """A header that promises a picture, and no picture."""
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(b"\0")), (b"IEND", b"")]
    parts = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def png_of(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("L", (width, height), 99).save(buffer, format="PNG")
    return buffer.getvalue()


NOISE = np.random.default_rng(1).integers(0, 256, (64, 64), dtype=np.uint8)


def jpeg() -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(NOISE).save(buffer, format="JPEG")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["empty"]),
        (b"not a picture at all", ["not a picture"]),
        (png_of(64, 64)[:60], ["damaged"]),
        (jpeg()[:2000], ["damaged"]),
        (png_of(1, 1), ["1 x 1", "at least 8 x 8"]),
        (png_of(300, 7), ["300 x 7", "at least 8 x 8"]),
        (huge_png(30_000, 30_000), ["900000000", "at most 100000000"]),
        (huge_png(10_001, 10_000), ["10001 x 10000", "at most 100000000"]),
        (huge_png(2**31 - 1, 2**31 - 1), ["at most 100000000"]),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n", ["not a picture"]),
    ],
)
def test_a_picture_that_cannot_be_used_is_one_line(tmp_path: Path, content: bytes, words: list[str]) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(PictureError) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert "a.png" in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_missing_and_folder_are_one_line(tmp_path: Path) -> None:
    for path in (tmp_path / "none.png", tmp_path):
        with pytest.raises(PictureError) as caught:
            read(path)
        assert "\n" not in str(caught.value)


def test_all_black_after_inversion_is_said_so(tmp_path: Path) -> None:
    path = saved(Image.new("L", (16, 16), 255), tmp_path / "white.png")
    with pytest.raises(PictureError, match="black everywhere after inversion"):
        read(path, invert=True)


def test_one_tone_shows_nothing_and_that_is_said(tmp_path: Path) -> None:
    picture = read(saved(Image.new("L", (16, 16), 90), tmp_path / "grey.png"))
    assert any("nothing to see" in sentence for sentence in picture.warnings)
    ramp = np.tile(np.arange(256, dtype=np.uint8), (256, 1))
    assert read(saved(Image.fromarray(ramp), tmp_path / "ramp.png")).warnings == ()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 3000), st.integers(0, 255), st.sampled_from(["PNG", "GIF", "TIFF", "BMP", "JPEG", "WEBP"]))
def test_a_flipped_byte_never_ends_in_anything_but_a_picture_or_a_line(place: int, value: int, kind: str) -> None:
    import tempfile

    buffer = io.BytesIO()
    Image.fromarray(NOISE[:24, :24]).save(buffer, format=kind)
    content = bytearray(buffer.getvalue())
    content[place % len(content)] = value
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(content)
        try:
            assert np.isfinite(read(path).linear).all()
        except PictureError as error:
            assert "\n" not in str(error)


@pytest.fixture(scope="module", params=[pytest.param("lens", marks=pytest.mark.thorough), "behind"])
def job(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A bright blob in the upper left of the picture, a smaller one half-way down at the left."""
    folder = tmp_path_factory.mktemp("orientation")
    y, x = np.mgrid[0:64, 0:64] / 63
    blobs = ((1.0, 0.35, 0.15, 0.012), (0.5, 0.15, 0.65, 0.01))
    light = 0.2 + sum(a * np.exp(-((x - u) ** 2 + (y - v) ** 2) / s) for a, u, v, s in blobs)
    Image.fromarray(np.rint(255 * light / light.max()).astype(np.uint8)).save(folder / "p.png")
    values = {
        "image.pixels": 64, "image.tone": "linear", "optics.width_mm": SIDE_MM, "optics.height_mm": SIDE_MM,
        "optics.throw_mm": THROW_MM, "optics.refractive_index": INDEX, "optics.viewed_from": request.param,
    }  # fmt: skip
    settings = [part for key, value in values.items() for part in ("--set", f"{key}={value}")]
    assert run(["design", str(folder / "p.png"), "-o", str(folder / "out"), "--quiet", *settings]) == 0
    return request.param, folder


def landing_points(lens: Heightfield) -> NDArray[np.float64]:
    """(n, 2) where parallel light that travels along +Z arrives on the screen, through a fine grid of lens points."""
    grid = (np.arange(400) + 0.5) / 400 * SIDE_MM
    x, y = (a.ravel() for a in np.meshgrid(grid, grid))
    z, zx, zy = lens.spline().jets(x, y)[:3]
    normal = np.stack([-zx, -zy, np.ones_like(zx)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    cos_in = normal[:, 2]
    cos_out = np.sqrt(1 - INDEX**2 * (1 - cos_in**2))
    out = INDEX * np.array([0.0, 0.0, 1.0]) + (cos_out - INDEX * cos_in)[:, None] * normal
    reach = (THROW_MM - z) / out[:, 2]
    return np.stack([x + reach * out[:, 0], y + reach * out[:, 1]], axis=1)


def seen_by_viewer(points_mm: NDArray[np.float64], viewed_from: str) -> NDArray[np.float64]:
    """What the viewer's eye makes of the spots on the screen: a 64 x 64 picture, row 0 on top.

    Both viewers stand upright, +Y up. On the lens's side one looks along +Z, and +X lies to the left hand; behind the
    screen one looks along -Z, and +X lies to the right hand.
    """
    x, y = points_mm.T / SIDE_MM
    to_the_right = 1 - x if viewed_from == "lens" else x
    picture, _, _ = np.histogram2d(1 - y, to_the_right, bins=64, range=[[0, 1], [0, 1]])
    return picture


def likeness(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def test_the_viewer_sees_the_picture_and_not_its_mirror(job: tuple[str, Path]) -> None:
    viewed_from, folder = job
    wanted = np.asarray(Image.open(folder / "p.png"), dtype=float)
    seen = seen_by_viewer(landing_points(load_heightfield(folder / "out" / "heightfield.npz")), viewed_from)
    assert likeness(seen, wanted) > 0.95
    for mirrored in (seen[::-1], seen[:, ::-1], seen[::-1, ::-1], seen.T):
        assert likeness(mirrored, wanted) < 0.6


@pytest.mark.parametrize("name", ["target.png", "caustic.png"])
def test_the_pictures_written_show_what_the_viewer_sees(job: tuple[str, Path], name: str) -> None:
    _, folder = job
    wanted = np.asarray(Image.open(folder / "p.png"), dtype=float)
    shown = Image.open(folder / "out" / name).convert("L").resize((64, 64), Image.Resampling.BOX)
    written = np.asarray(shown, dtype=float)
    assert likeness(written, wanted) > 0.9
    for mirrored in (written[::-1], written[:, ::-1], written[::-1, ::-1]):
        assert likeness(mirrored, wanted) < 0.6


def save_levels(levels: np.ndarray, path: Path) -> Path:
    Image.fromarray(np.rint(levels).astype(np.uint16)).save(path)
    return path


@pytest.mark.parametrize(("width", "height"), [(200, 150), (64, 65), (63, 10), (8, 9)])
def test_a_ramp_is_a_ramp_from_rim_to_rim(tmp_path: Path, width: int, height: int) -> None:
    """Values in the middle of pixels; a point at the rim is the mean over half a box, a quarter of a box further in."""
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    levels = 60000 * (0.1 + 0.3 * x[None, :] + 0.6 * y[:, None])
    rows = np.array(light_rows(save_levels(levels, tmp_path / "a.png"), tone="linear"))
    columns, lines = min(64, width), min(64, height)
    assert rows.shape == (lines, columns)
    place = [np.linspace(0, 1, n) for n in (columns, lines)]
    for at, n in zip(place, (columns, lines), strict=True):
        at[[0, -1]] += np.array([0.25, -0.25]) / (n - 1)
    wanted = 0.1 + 0.3 * place[0][None, :] + 0.6 * place[1][:, None]
    box_of_whole_pixels = 0.3 / width + 0.6 / height  # what a box loses by covering parts of pixels
    assert rows == pytest.approx(wanted / wanted.max(), abs=box_of_whole_pixels)


def test_dust_and_noise_are_averaged_away(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    levels = 40000 + 4000 * rng.standard_normal((640, 640))
    rows = np.array(light_rows(save_levels(levels, tmp_path / "a.png"), tone="linear"))
    assert rows[1:-1, 1:-1].std() / rows.mean() < 1.3 * 0.1 / 10  # boxes of 10 x 10 pixels


def test_the_tones_are_those_of_the_job(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.repeat([[128, 255], [128, 255]], 4, axis=1).repeat(4, axis=0).astype(np.uint8)).save(path)
    assert light_rows(path, tone="srgb")[0][0] == pytest.approx(0.216, abs=1e-3)
    assert light_rows(path, tone="linear")[0][0] == pytest.approx(128 / 255, abs=1e-3)
    linear = resolve_spec(overrides=["image.tone=linear"], light_picture=path).optics.light.profile
    assert linear == [[0.502] * 4 + [1.0] * 4] * 8


def test_what_is_no_picture_of_light_is_one_line(tmp_path: Path) -> None:
    black, thin = tmp_path / "black.png", tmp_path / "thin.png"
    Image.new("L", (8, 8)).save(black)
    Image.new("L", (1, 9), 9).save(thin)
    for path, words in ((black, "black everywhere"), (thin, "at least 8 x 8"), (tmp_path / "none.png", "none.png")):
        with pytest.raises(ServiceError, match=words) as caught:
            light_rows(path, tone="srgb")
        assert "\n" not in str(caught.value)
    with pytest.raises(ServiceError, match=r"gaussian_mm: 90 is not allowed beside profile"):
        path = save_levels(np.full((8, 8), 9), tmp_path / "even.png")
        resolve_spec(overrides=["optics.light.gaussian_mm=90"], light_picture=path)


@pytest.mark.thorough
def test_the_command_designs_for_the_light_and_the_job_remembers_it(tmp_path: Path) -> None:
    x = np.linspace(0, 1, 40)
    light = save_levels(50000 * (0.4 + 0.6 * x[None, :] * np.ones((30, 1))), tmp_path / "light.png")
    picture = save_levels(30000 * (1.2 + np.sin(6 * x[None, :]) * np.cos(5 * x[:, None])), tmp_path / "p.png")
    settings = [part for value in ("image.pixels=32", "image.tone=linear") for part in ("--set", value)]
    assert (
        run(["design", str(picture), "-o", str(tmp_path / "out"), "-q", "--light-picture", str(light), *settings]) == 0
    )
    spec = json.loads((tmp_path / "out" / "spec.json").read_text())
    assert np.shape(spec["optics"]["light"]["profile"]) == (30, 40)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["optics"]["psnr_db"] > 30


def test_the_client_sends_the_light_with_the_spec(tmp_path: Path) -> None:
    path = save_levels(np.full((8, 9), 9000), tmp_path / "light.png")
    text = spec_text(file=None, preset=None, overrides=(), light_picture=path)
    assert text is not None
    assert json.loads(text)["optics"]["light"]["profile"] == [[1.0] * 9] * 8
