"""Random and adversarial pictures, drawn here: what a lens must survive, whatever it can make of it.

Each kind is a function (rng, rows, columns) -> (rows, columns) linear light, row 0 on top, not all black.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

Picture = np.ndarray
Kind = Callable[[np.random.Generator, int, int], Picture]
SIDES = (64, 96, 128)


@dataclass(frozen=True)
class Hard:
    """One picture: its kind, its number among all, and its light."""

    kind: str
    number: int
    picture: Picture


def _axes(ny: int, nx: int) -> tuple[Picture, Picture]:
    row, column = np.mgrid[0:ny, 0:nx]
    return row / max(ny - 1, 1), column / max(nx - 1, 1)


def _checkerboard(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    period, floor = int(rng.choice([1, 2, 3, 5, 8, 16, 32])), float(rng.choice([0.0, 0.0, 1e-3, 0.1]))
    row, column = np.mgrid[0:ny, 0:nx] // period
    return np.where((row + column) % 2 == 0, 1.0, floor)


def _stripes(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    row, column = np.mgrid[0:ny, 0:nx]
    along = (column, row, row + column, row + 2 * column)[int(rng.integers(4))]
    period = int(rng.choice([2, 3, 4, 7, 16, 40]))
    return np.where(along % period < max(period // 2, 1), 1.0, float(rng.choice([0.0, 1e-3, 0.05])))


def _one_pixel(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    picture = np.full((ny, nx), float(rng.choice([0.0, 1e-4, 1e-2])))
    row, column = [(0, 0), (ny // 2, nx // 2), (0, nx // 2), (ny - 1, nx - 1), (ny // 3, nx - 1)][int(rng.integers(5))]
    picture[row, column] = 1.0
    return picture


def _dots(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    picture = np.zeros((ny, nx))
    for _ in range(int(rng.integers(2, 8))):
        size = int(rng.integers(1, 4))
        row, column = int(rng.integers(0, ny - size)), int(rng.integers(0, nx - size))
        picture[row : row + size, column : column + size] = rng.uniform(0.2, 1.0)
    return picture


def _one_black_pixel(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    picture = np.ones((ny, nx))
    for _ in range(int(rng.integers(1, 20))):
        picture[int(rng.integers(ny)), int(rng.integers(nx))] = 0.0
    return picture


def _gradient(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    y, x = _axes(ny, nx)
    angle = rng.uniform(0, 2 * math.pi)
    ramp = math.cos(angle) * (x - 0.5) + math.sin(angle) * (y - 0.5)
    ramp = (ramp - ramp.min()) / np.ptp(ramp)
    return (ramp, ramp**3, 1000.0**ramp, np.hypot(x - 0.5, y - 0.5))[int(rng.integers(4))]


def _text(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    words = ["caustic", "MILL 42", "light & glass", "0123456789", "i.l!|", "The quick brown fox jumps over"]
    image = Image.new("L", (nx, ny))
    draw, size = ImageDraw.Draw(image), int(rng.integers(7, 24))
    for line in range(0, ny, size + 2):
        draw.text((2, line), str(rng.choice(words)), fill=255, font=ImageFont.load_default(size))
    light = np.asarray(image, dtype=np.float64) / 255
    light[ny // 2, nx // 2] = 1.0
    return 1.0 - light if rng.random() < 0.5 else light


def _strokes(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    image = Image.new("L", (nx, ny))
    draw = ImageDraw.Draw(image)
    for _ in range(int(rng.integers(1, 6))):
        ends = [(float(rng.uniform(0, nx)), float(rng.uniform(0, ny))) for _ in range(2)]
        draw.line(ends, fill=255, width=int(rng.integers(1, 3)))
    draw.line([(0.3 * nx, 0.5 * ny), (0.7 * nx, 0.5 * ny)], fill=255)
    return np.asarray(image, dtype=np.float64) / 255


def _silhouette(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    image = Image.new("L", (nx, ny))
    draw = ImageDraw.Draw(image)
    for _ in range(int(rng.integers(1, 4))):
        cx, cy, count = rng.uniform(0.2, 0.8) * nx, rng.uniform(0.2, 0.8) * ny, int(rng.integers(3, 9))
        reach = rng.uniform(0.1, 0.45, count) * min(nx, ny)
        angles = 2 * math.pi * np.arange(count) / count
        draw.polygon(
            [(cx + r * math.cos(a), cy + r * math.sin(a)) for r, a in zip(reach, angles, strict=True)], fill=255
        )
    light = np.asarray(image, dtype=np.float64) / 255
    return 1.0 - light if rng.random() < 0.3 else light


def _binary_noise(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    picture = (rng.random((ny, nx)) < rng.choice([0.02, 0.1, 0.5, 0.9])).astype(float)
    picture[0, 0] = 1.0
    return picture


def _noise(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    return np.asarray(float(rng.choice([2.0, 30.0, 1000.0])) ** rng.random((ny, nx)))


def _soft_noise(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    field = gaussian_filter(rng.normal(size=(ny, nx)), rng.choice([1.0, 3.0, 8.0]), mode="reflect")
    field = (field - field.min()) / np.ptp(field)
    return np.asarray((field**2, np.maximum(field - 0.5, 0.0), 1000.0**field)[int(rng.integers(3))])


def _blobs_of_1000(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    y, x = _axes(ny, nx)
    light = np.full((ny, nx), 1e-3)
    for _ in range(int(rng.integers(1, 6))):
        cx, cy, width = rng.random(), rng.random(), rng.uniform(0.02, 0.15)
        light = np.maximum(light, np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / width**2))
    return light


def _rings(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    y, x = _axes(ny, nx)
    radius = np.hypot(x - 0.5, y - 0.5) * rng.uniform(4, 40)
    return np.asarray(0.5 + 0.5 * np.cos(2 * math.pi * radius)) ** int(rng.integers(1, 8))


def _frame(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    """Light at the rim only, or anywhere but there."""
    wide = int(rng.integers(1, max(min(ny, nx) // 4, 2)))
    inner = np.zeros((ny, nx))
    inner[wide : ny - wide, wide : nx - wide] = 1.0
    return inner if rng.random() < 0.5 and inner.any() else 1.0 - inner


def _half(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    y, x = _axes(ny, nx)
    light = ((x < 0.5), (y < 0.5), (x + y < 0.6), (x < 0.1))[int(rng.integers(4))]
    return np.where(light, 1.0, float(rng.choice([0.0, 1e-3])))


def _even(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    return np.full((ny, nx), rng.uniform(1e-6, 1e6))


def _photograph(rng: np.random.Generator, ny: int, nx: int) -> Picture:
    """A piece of one of the photographs that scikit-image's wheel carries."""
    from skimage import data

    name = str(rng.choice(["camera", "astronaut", "coins", "moon", "page", "text", "chelsea", "coffee", "rocket"]))
    grey = np.asarray(Image.fromarray(getattr(data, name)()).convert("L"), dtype=np.float32) / 255
    side = min(grey.shape)
    row, column = (int(rng.integers(0, n - side + 1)) for n in grey.shape)
    piece = Image.fromarray(grey[row : row + side, column : column + side])
    return np.asarray(piece.resize((nx, ny), Image.Resampling.BOX), dtype=np.float64) ** float(
        rng.choice([1.0, 2.2, 5])
    )


KINDS: dict[str, Kind] = {
    "checkerboard": _checkerboard, "stripes": _stripes, "one bright pixel": _one_pixel, "dots": _dots,
    "black pixels": _one_black_pixel, "gradient": _gradient, "text": _text, "thin strokes": _strokes,
    "silhouette": _silhouette, "binary noise": _binary_noise, "noise": _noise, "soft noise": _soft_noise,
    "blobs, 1:1000": _blobs_of_1000, "rings": _rings, "frame": _frame, "half black": _half, "even": _even,
    "photograph": _photograph,
}  # fmt: skip
RIBBONS = ("gradient", "text", "stripes", "silhouette", "noise", "photograph")


def hard_pictures(count: int = 300, *, seed: int = 5) -> Iterator[Hard]:
    """`count` pictures: the kinds in turn, of varying side and shape, and last some of 16 x 4096 and 4096 x 16."""
    ribbons = min(len(RIBBONS), count // 8)
    names = list(KINDS)
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        ribbon = number - (count - ribbons)
        if ribbon >= 0:
            kind, shape = RIBBONS[ribbon], ((16, 4096), (4096, 16))[ribbon % 2]
        else:
            kind, side = names[number % len(names)], int(rng.choice(SIDES))
            shape = (side, side) if rng.random() < 0.7 else (side, int(rng.integers(20, 2 * side)))
        yield Hard(kind, number, KINDS[kind](rng, *shape))
