"""A measured picture of the light becomes rows of strength from rim to rim."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from service.cli.main import run
from service.client.submit import spec_text
from service.errors import ServiceError
from service.job.picture.reading import light_rows
from service.job.spec.loading import resolve_spec


def saved(levels: np.ndarray, path: Path) -> Path:
    Image.fromarray(np.rint(levels).astype(np.uint16)).save(path)
    return path


@pytest.mark.parametrize(("width", "height"), [(200, 150), (64, 65), (63, 10), (8, 9)])
def test_a_ramp_is_a_ramp_from_rim_to_rim(tmp_path: Path, width: int, height: int) -> None:
    """Values in the middle of pixels; a point at the rim is the mean over half a box, a quarter of a box further in."""
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    levels = 60000 * (0.1 + 0.3 * x[None, :] + 0.6 * y[:, None])
    rows = np.array(light_rows(saved(levels, tmp_path / "a.png"), tone="linear"))
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
    rows = np.array(light_rows(saved(levels, tmp_path / "a.png"), tone="linear"))
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
        path = saved(np.full((8, 8), 9), tmp_path / "even.png")
        resolve_spec(overrides=["optics.light.gaussian_mm=90"], light_picture=path)


@pytest.mark.thorough
def test_the_command_designs_for_the_light_and_the_job_remembers_it(tmp_path: Path) -> None:
    x = np.linspace(0, 1, 40)
    light = saved(50000 * (0.4 + 0.6 * x[None, :] * np.ones((30, 1))), tmp_path / "light.png")
    picture = saved(30000 * (1.2 + np.sin(6 * x[None, :]) * np.cos(5 * x[:, None])), tmp_path / "p.png")
    settings = [part for value in ("image.pixels=32", "image.tone=linear") for part in ("--set", value)]
    assert (
        run(["design", str(picture), "-o", str(tmp_path / "out"), "-q", "--light-picture", str(light), *settings]) == 0
    )
    spec = json.loads((tmp_path / "out" / "spec.json").read_text())
    assert np.shape(spec["optics"]["light"]["profile"]) == (30, 40)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["optics"]["psnr_db"] > 30


def test_the_client_sends_the_light_with_the_spec(tmp_path: Path) -> None:
    path = saved(np.full((8, 9), 9000), tmp_path / "light.png")
    text = spec_text(file=None, preset=None, overrides=(), light_picture=path)
    assert text is not None
    assert json.loads(text)["optics"]["light"]["profile"] == [[1.0] * 9] * 8
