"""`causticmill look`: a photograph of the wall, of the lens in a job's folder, in sentences and figures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from optics.caustic import simulate_caustic
from optics.irradiance import picture_from_irradiance
from optics.photograph.wall import Estimate
from optics.spline import Array
from service.cli import main as cli
from service.errors import InputError, PictureError
from service.job.arrays import heightfield_bytes, target_bytes
from service.job.photo.findings import SENTENCES, PhotoFinding, UselessPhotoError
from service.job.photo.looking import _find_tilt, load_predicted_light, look_at
from service.job.picture import PictureLimits
from service.job.picture.light_png import picture_png
from service.job.picture.reading import WallPhoto, read_wall_photo
from service.job.spec.lens_task import bench_of
from service.job.spec.loading import resolve_spec
from tests.optics.photograph.test_wall import PIXELS, RIM, SIDE_MM, THROW_MM, light_on_the_wall, portrait_lens
from tests.optics.photographs import camera, photographed

SHAPE = (450, 600)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job as `design` leaves it, as far as a look needs it."""
    overrides = [f"image.pixels={PIXELS}", f"optics.width_mm={SIDE_MM}", f"optics.height_mm={SIDE_MM}"]
    spec = resolve_spec(preset="draft", overrides=[*overrides, f"optics.throw_mm={THROW_MM}"])
    folder = tmp_path_factory.mktemp("job")
    lens = portrait_lens(bench_of(spec))
    light = simulate_caustic(lens, bench_of(spec), pixels=(PIXELS, PIXELS)).irradiance
    (folder / "spec.json").write_text(json.dumps(spec.plain()))
    (folder / "heightfield.npz").write_bytes(heightfield_bytes(lens))
    (folder / "map.npz").write_bytes(target_bytes(light))
    return folder


@pytest.fixture(scope="module")
def wall(job: Path) -> Array:
    """The light with the wall 2 % too far, as a viewer sees it."""
    predicted = load_predicted_light(job)
    return light_on_the_wall(predicted.lens, predicted.bench, throw_mm=1.02 * THROW_MM)


def photo_of(wall: Array, *, at: dict[str, Any] | None = None, **conditions: Any) -> Array:
    place = camera(shape=SHAPE, **(at or {"aside_deg": 25.0, "roll_deg": 1.0}))
    return photographed(wall, place, margin=RIM / PIXELS, shape=SHAPE, **conditions).photo


def saved(light: Array, path: Path, *, colour: bool = True) -> Path:
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    image = Image.fromarray(np.rint(255 * encoded).astype(np.uint8))
    (image.convert("RGB") if colour else image).save(path, **({"quality": 92} if path.suffix == ".jpg" else {}))
    return path


@pytest.mark.thorough
def test_the_command_tells_prints_and_draws(
    job: Path, wall: Array, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From a phone's file: the wall too far with how much, the turn of the picture; the same in look.json."""
    photo = saved(photo_of(wall), tmp_path / "phone.jpg")
    assert cli.run(["look", str(photo), "--job", str(job), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "too far: move it nearer to the lens" in said
    told = json.loads((tmp_path / "out" / "look.json").read_text())
    assert told["wall"]["throw_off_mm"] == pytest.approx(0.02 * THROW_MM, rel=0.25)
    assert told["place"]["turned_deg"] == pytest.approx(1.0, abs=0.3)
    codes = [row["code"] for row in told["findings"]]
    assert codes[0] == "wall_too_far"
    assert "turned" in codes
    assert "surface_off" not in codes
    assert all(row["text"] in said for row in told["findings"])
    with Image.open(tmp_path / "out" / "look.png") as picture:
        assert picture.size[0] > 1000


def refused(photo: Array, job: Path) -> UselessPhotoError:
    with pytest.raises(UselessPhotoError) as caught:
        look_at(WallPhoto(light=photo, width=600, height=450), load_predicted_light(job), name="wall.jpg")
    assert str(caught.value).startswith("wall.jpg: ")
    return caught.value


@pytest.mark.thorough
def test_a_photograph_that_tells_nothing_is_refused_with_its_reason(job: Path, wall: Array) -> None:
    """One reason, by its code, and what to do."""
    other = np.asarray(Image.open("examples/logo.png").convert("L").resize(wall.shape[::-1]), dtype=np.float64) ** 2.2
    assert refused(photo_of(wall, stops=-9), job).finding.code == "too_dark"
    assert refused(photo_of(wall, stops=5), job).finding.code == "too_bright"
    assert refused(photo_of(other), job).finding.code == "not_this_lens"
    assert refused(photo_of(wall, at={"aside_deg": 0.0, "filling": 0.06}), job).finding.code == "too_small"
    assert refused(photo_of(wall)[:, :330], job).finding.code in ("cut_off", "not_this_lens")
    assert refused(np.full(SHAPE, 0.5), job).finding.code == "no_light"


@pytest.mark.thorough
def test_a_mirrored_photograph_is_told_and_still_read(job: Path, wall: Array) -> None:
    found = look_at(
        WallPhoto(light=photo_of(wall)[:, ::-1], width=600, height=450), load_predicted_light(job), name="selfie.jpg"
    )
    assert found.findings[0].code == "mirrored"
    assert found.findings[1].code == "wall_too_far"


def test_the_best_picture_of_the_job_is_what_was_foretold(job: Path, tmp_path: Path) -> None:
    """As finished before as milled before the lens's own light; where a file is white, no more is known than that."""
    folder = tmp_path / "job"
    folder.mkdir()
    for name in ("spec.json", "heightfield.npz", "map.npz"):
        (folder / name).write_bytes((job / name).read_bytes())
    designed = load_predicted_light(folder)
    assert designed.kind == "designed"
    seen = picture_from_irradiance(designed.irradiance, viewed_from="lens")
    white = float(designed.irradiance.max())
    (folder / "caustic-as-milled.png").write_bytes(picture_png(0.8 * seen, white=white))
    milled = load_predicted_light(folder)
    assert milled.kind == "milled"
    assert np.nanmax(np.abs(milled.irradiance - 0.8 * designed.irradiance)) < 0.02 * white
    (folder / "caustic-as-finished.png").write_bytes(picture_png(2 * seen, white=white))
    finished = load_predicted_light(folder)
    assert finished.kind == "finished"
    assert np.isnan(finished.irradiance).any()
    assert np.isfinite(finished.bounded).all()


def test_a_folder_without_a_lens_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = saved(np.full((40, 50), 0.5), tmp_path / "p.png")
    assert cli.run(["look", str(photo), "--job", str(tmp_path / "none")]) == 2
    assert "--job" in capsys.readouterr().err
    assert cli.run(["look", str(photo), "--job", str(tmp_path)]) == 2
    with pytest.raises(InputError):
        load_predicted_light(tmp_path)


def test_a_file_that_is_no_picture_is_refused_in_one_line(
    job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "notes.jpg"
    path.write_text("no picture")
    assert cli.run(["look", str(path), "--job", str(job)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(PictureError, match="allowed: at most"):
        read_wall_photo(saved(np.full((400, 500), 0.5), tmp_path / "large.png"), limits=PictureLimits(max_pixels=1000))


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P", "I;16", "CMYK"])
def test_a_photograph_of_any_mode_is_linear_light(tmp_path: Path, mode: str) -> None:
    levels = np.tile(np.arange(0, 240, 4, dtype=np.uint8), (30, 1))
    image = Image.fromarray(levels)
    path = tmp_path / ("photo.tiff" if mode in ("I;16", "CMYK") else "photo.png")
    (Image.fromarray(levels.astype(np.uint16) * 257) if mode == "I;16" else image.convert(mode)).save(path)
    found = read_wall_photo(path).light
    assert found.shape == levels.shape
    assert np.abs(found - (levels / 255.0) ** 2.2).max() < 0.02


def test_a_colour_that_is_clipped_alone_counts_as_white(tmp_path: Path) -> None:
    """Of a warm lamp red is full long before the luminance is."""
    pixels = np.zeros((40, 60, 3), dtype=np.uint8)
    pixels[:, :30] = (255, 120, 40)
    pixels[:, 30:] = (200, 120, 40)
    Image.fromarray(pixels).save(tmp_path / "warm.png")
    found = read_wall_photo(tmp_path / "warm.png").light
    assert (found[:, :30] == 1.0).all()
    assert found[:, 30:].max() < 0.5


def test_a_large_photograph_is_read_smaller(tmp_path: Path) -> None:
    path = saved(np.tile(np.linspace(0, 1, 4000), (1000, 1)), tmp_path / "large.png")
    found = read_wall_photo(path)
    assert found.light.shape == (400, 1600)
    assert (found.width, found.height) == (4000, 1000)


def test_every_code_has_a_sentence_that_its_values_make(job: Path) -> None:
    """Nothing that is found is without words: each is said with what `looking` gives it."""
    values: dict[str, Any] = {
        **dict.fromkeys(("mm", "deviation_mm", "within_mm", "throw_mm", "deg", "deviation_deg", "tone"), 1.0),
        **dict.fromkeys(("foretold_mm", "source_deg", "peak_to_valley_um", "within_um", "clipped_percent"), 1.0),
        **dict.fromkeys(
            ("peak_percent", "least_percent", "most_percent", "across_px", "least_px", "seen_percent"), 1.0
        ),
        "likeness": 0.4,
        "least": 0.6,
        "foretold": "milled",
        "viewed_from": "lens",
        "sides": ["left", "top"],
        "terms": [{"order_x": 2, "order_y": 1, "um": 4.0, "deviation_um": 0.5}],
    }
    for code in SENTENCES:
        found = PhotoFinding(code, values)
        assert found.sentence() and str(UselessPhotoError("x", found)) == f"x: {found.sentence()}"


def test_sides_are_those_of_the_viewer(job: Path) -> None:
    """Work-frame x runs to the left for who stands beside the lens, to the right for who stands behind the screen."""
    sure, none = (Estimate(value=value, deviation=0.001, expected=0.05) for value in (0.04, 0.0))
    here = load_predicted_light(job)
    there = replace(here, viewed_from="behind")
    assert _find_tilt("wall_tilted", (sure, none), here)[0].values["sides"] == ["left"]
    assert _find_tilt("wall_tilted", (sure, none), there)[0].values["sides"] == ["right"]
    assert _find_tilt("wall_tilted", (none, sure), here)[0].values["sides"] == ["top"]
    assert _find_tilt("wall_tilted", (none, none), here) == []
