"""A job's picture prepared for the wall: only where asked for, to scale, shown and scored beside the original."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from optics.black import valley_leak
from optics.irradiance import target_irradiance
from service.errors import SpecError
from service.job import files as job_files
from service.job.arrays import load_original, load_target
from service.job.picture import OWN_PICTURE
from service.job.planning.estimate import estimate
from service.job.planning.preparation import (
    aim_at_picture,
    detail_to_prepare_for_mm,
    score_against,
    scores_against_original,
)
from service.job.report.finishing import make_finishing_card
from service.job.report.optics import sentences_of_preparation
from service.job.spec.lens_task import bench_of
from service.job.spec.loading import resolve_spec
from service.job.spec.resolve import look_up
from tests.service.job.report.sheet import render_report
from tests.service.job.stages.jobs import save_picture, staged_job, tiny_spec

DETAIL = "image.prepare=detail"


def soft(side: int = 48) -> np.ndarray:
    y, x = np.mgrid[:side, :side] / side
    return (0.1 + 0.6 * x) * (1 + 0.3 * np.sin(40 * y) * np.sin(31 * x))


def test_a_picture_is_prepared_only_where_it_is_asked_for() -> None:
    plain, prepared = (aim_at_picture(resolve_spec(overrides=keys), soft()) for keys in ([], [DETAIL]))
    assert plain.original is None and plain.figures() == {}
    assert prepared.original is not None
    assert (prepared.original == plain.target).all()
    assert (plain.target == target_irradiance(soft(), viewed_from="lens")).all()
    assert not np.allclose(prepared.target, plain.target)
    assert prepared.target.mean() == pytest.approx(1.0)
    told = prepared.figures()
    assert told["prepared"] is True
    assert told["against_original"] == score_against(prepared.target, plain.target)


def test_two_tones_stay_and_it_is_said() -> None:
    logo = (soft() > 0.4).astype(float)
    aimed = aim_at_picture(resolve_spec(overrides=[DETAIL]), logo)
    assert aimed.original is None
    assert (aimed.target == target_irradiance(logo, viewed_from="lens")).all()
    (sentence,) = sentences_of_preparation({"image": aimed.figures()})
    assert "left as it is" in sentence


@pytest.mark.parametrize(
    ("keys", "detail_mm"),
    [
        ([], 0.98),  # 0.02 rad, bent by 0.49, over 100 mm
        (["optics.throw_mm=200"], 1.96),
        (["optics.throw_mm=10"], 0.39),  # two pixels
        (["optics.surface=mirror"], 4.0),
        (["optics.light={kind='sun'}"], np.hypot(0.98, 0.925)),
        (["image.prepare_detail_mm=2.5"], 2.5),
    ],
)
def test_the_detail_is_the_person_s_or_that_of_wall_and_light(keys: list[str], detail_mm: float) -> None:
    spec = resolve_spec(overrides=[DETAIL, *keys])
    assert detail_to_prepare_for_mm(spec, columns=512) == pytest.approx(detail_mm, rel=2e-3)


def test_the_detail_is_a_length_on_the_screen() -> None:
    """Twice the screen and twice the detail on it: the same picture."""
    one = aim_at_picture(resolve_spec(overrides=[DETAIL, "image.prepare_detail_mm=3"]), soft())
    two = ["optics.screen_width_mm=200", "image.prepare_detail_mm=6"]
    assert np.allclose(one.target, aim_at_picture(resolve_spec(overrides=[DETAIL, *two]), soft()).target)


def test_black_is_lifted_to_what_valleys_under_the_ball_leak() -> None:
    picture = soft()
    picture[:16] = 0.0
    keys = [DETAIL, "optics.branch=direct", "optics.min_radius_mm=3"]
    spec = resolve_spec(overrides=keys)
    leak = valley_leak(bench_of(spec), 3.0)
    assert 0.05 < leak < 0.07
    assert aim_at_picture(spec, picture).target.min() == pytest.approx(leak, rel=0.01)
    for dark in ([*keys[:2], "optics.min_radius_mm=0"], [DETAIL, "optics.branch=inverted", keys[2]]):
        assert aim_at_picture(resolve_spec(overrides=dark), picture).target.min() < 1e-3


def test_a_detail_without_a_preparation_is_one_line() -> None:
    with pytest.raises(SpecError, match=r"^image\.prepare_detail_mm: 2 is not allowed with prepare = 'none'"):
        resolve_spec(overrides=["image.prepare_detail_mm=2"])


@pytest.mark.thorough
def test_a_job_keeps_both_pictures_and_scores_against_both(tmp_path: Path) -> None:
    """To its end: lens, as milled, as finished; and its sheet leads through the finish."""
    keys = (DETAIL, "image.prepare_detail_mm=0.5", "finish.process=felt")
    job = staged_job(tmp_path, spec=tiny_spec(*keys)).run_all()
    (tmp_path / "map.npz").write_bytes(job.bytes("map.npz"))
    original, target = load_original(tmp_path / "map.npz"), load_target(tmp_path / "map.npz")
    assert original is not None
    assert job.report["image"]["against_original"] == score_against(target, original)
    assert scores_against_original(tmp_path / "map.npz", target) == {
        "against_original": score_against(target, original)
    }
    for part in ("optics", "as_milled", "as_finished"):
        assert job.report[part]["against_original"]["psnr_db"] != job.report[part]["psnr_db"]
    report = json.loads(job.bytes("report.json"))
    assert report["finishing"]["process"] == "felt"
    page = job.bytes("report.html").decode()
    assert "Finishing by hand: Polishing with felt" in page and "The lens aims at a prepared picture" in page
    with Image.open(io.BytesIO(job.bytes("prepared.png"))) as drawn:
        assert drawn.width > 1.6 * drawn.height
    assert job_files.is_known("prepared.png")


def test_estimates_and_plans_aim_at_the_prepared_picture_too(tmp_path: Path) -> None:
    picture = save_picture(tmp_path / "blob.png")
    keys = ([], [DETAIL, "image.prepare_detail_mm=0.5"])
    found = [estimate(look_up(tiny_spec(*own)), picture, limits=OWN_PICTURE, name="blob") for own in keys]
    assert found[0]["psnr_db"] != found[1]["psnr_db"]
    assert found[0]["relief_mm"] != found[1]["relief_mm"]


def test_a_job_that_prepares_nothing_has_nothing_of_it(tmp_path: Path) -> None:
    job = staged_job(tmp_path, spec=tiny_spec())
    for stage in ("image", "irradiance", "map"):
        job.run(stage)
    assert not {"prepared.png", ".original.npz"} & set(job.outputs)
    assert "image" not in job.report
    (tmp_path / "map.npz").write_bytes(job.bytes("map.npz"))
    assert scores_against_original(tmp_path / "map.npz", np.ones((24, 24))) == {}


IMAGE: dict[str, Any] = {
    "prepare": "detail", "prepare_detail_mm": 1.3, "prepared": True, "black_share": 0.06,
    "against_original": {"psnr_db": 20.5, "ssim": 0.81},
}  # fmt: skip


def test_the_sheet_says_what_was_done_and_which_picture_scores_are_against() -> None:
    milled = {"psnr_db": 24.0, "against_original": {"psnr_db": 18.2, "ssim": 0.5}}
    (sentence,) = sentences_of_preparation({"image": IMAGE, "as_milled": milled})
    for words in ("1.3 mm", "6.0 % of the mean", "20.5 dB, SSIM 0.810", "as milled 18.2 dB"):
        assert words in sentence
    page = render_report({"image": IMAGE}, files=["prepared.png"])
    assert 'src="prepared.png"' in page and "contrast is raised" in page
    assert sentences_of_preparation({}) == []


def test_words_compare_the_wall_with_the_picture_as_given() -> None:
    """A prepared picture of more contrast scores lower for the same wall; a person does not see it."""
    finished = {"psnr_db": 19.2, "seen_db": 8.0, "against_original": {"psnr_db": 21.6, "seen_db": 12.0, "ssim": 0.6}}
    card = make_finishing_card({"finishing": {"process": "felt", "steps": ["Rub."]}, "as_finished": finished})
    assert card is not None
    assert card["rows"] == [("The wall as finished", "21.6 dB: recognisable, visibly soft or uneven")]
