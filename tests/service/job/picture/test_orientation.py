"""A picture that looks the same in no mirror, followed all the way to the eye of the viewer.

The light is traced here by Snell's law written out once more, and the viewer is described by where they stand, so that
neither the project's forward model nor its one flipping function is taken at its word.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from optics.heightfield import Heightfield
from service.cli.main import run
from service.job.arrays import load_heightfield

SIDE_MM, THROW_MM, INDEX = 20.0, 40.0, 1.49


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
