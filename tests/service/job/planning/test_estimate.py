"""Estimates against the jobs that they are of, and against what follows from the spec alone."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from optics.design import design_lens
from optics.heightfield import Array
from optics.irradiance import target_irradiance
from optics.metrics import psnr_db
from service.errors import PictureError, SpecError
from service.job.picture import OWN_PICTURE, PictureLimits, decoding, reading
from service.job.picture.linear_light import srgb_to_linear
from service.job.picture.reading import read_picture
from service.job.picture.resampling import resize
from service.job.planning import estimate as estimating
from service.job.planning.estimate import PIXELS, coarse_spec, estimate
from service.job.planning.lens_facts import measure_lens
from service.job.planning.plan import Planned
from service.job.planning.planner import plan_for_picture
from service.job.planning.predicted_light import WALL_PIXELS
from service.job.spec import lens_task
from service.job.spec.lens_task import lens_settings
from service.job.spec.loading import resolve_spec
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob, look_up
from service.job.stages import kept_plans
from tests.phrases.sentences import untold
from tests.service.job.stages.jobs import StagedJob, run_job

PICTURES = Path(__file__).parents[4] / "examples"
SMALL = ("optics.width_mm=20", "optics.height_mm=20", "optics.throw_mm=30", "image.pixels=128")


def estimated(spec: JobSpec, picture: str = "camera", *, exactly: bool = False) -> dict[str, Any]:
    path = PICTURES / f"{picture}.png"
    return estimate(look_up(spec), path, limits=OWN_PICTURE, name=path.name, exactly=exactly)


def small(*values: str, preset: str = "draft") -> JobSpec:
    return resolve_spec(preset=preset, overrides=(*SMALL, *values))


@pytest.mark.thorough
@pytest.mark.parametrize("picture", ["camera", "astronaut", "logo"])
def test_relief_and_slope_are_nearly_those_of_a_lens_three_times_as_fine(picture: str) -> None:
    """The large forms make the relief; fine detail makes slopes steeper, so that these are only so good."""
    spec = resolve_spec(preset="draft", overrides=(f"image.pixels={3 * PIXELS}", "optics.corrections=1"))
    found = estimated(spec, picture)
    read = read_picture(PICTURES / f"{picture}.png", spec.image, rows=3 * PIXELS, aspect=1.0)
    target = target_irradiance(read.linear, viewed_from="lens")
    lens = design_lens(target, lens_settings(spec, branch="direct")).heightfield
    facts = measure_lens(lens)
    assert found["relief_mm"] == pytest.approx(facts.relief_mm, rel=0.05)
    assert found["max_slope_deg"] == pytest.approx(facts.max_slope_deg, rel=0.15)


@pytest.mark.parametrize("exactly", [False, True])
def test_the_lens_is_of_the_branch_that_the_job_s_own_picture_suggests(
    monkeypatch: pytest.MonkeyPatch, exactly: bool
) -> None:
    """A coarser picture has less black: it suggested another lens, a third as deep."""
    spec = small("image.pixels=600", "optics.throw_mm=80")
    monkeypatch.setattr(estimating, "MOST_PIXELS", 100)
    given = {
        branch: estimated(small("image.pixels=600", "optics.throw_mm=80", f"optics.branch={branch}"), exactly=exactly)
        for branch in ("direct", "inverted")
    }
    monkeypatch.setattr(
        lens_task, "choose_branch", lambda target, *_: "inverted" if target.shape == (600, 600) else "direct"
    )
    found = estimated(spec, exactly=exactly)
    assert found["relief_mm"] == given["inverted"]["relief_mm"] > given["direct"]["relief_mm"]


def test_a_tool_that_does_not_get_to_the_rims_is_told_in_every_language() -> None:
    words, felt = "the tool of the finish does not reach the rims", "finish.process=felt"
    thin = ("passes.1.radius_mm=0.5", "passes.1.pitch_mm=0.05", "optics.min_radius_mm=3")
    told = estimated(small(felt, *thin))
    (warning,) = (one for one in told["warnings"] if words in one)
    assert warning in told["phrases"]
    assert not any(words in one for other in (small(felt), small(*thin)) for one in estimated(other)["warnings"])


@pytest.mark.thorough
def test_a_finish_is_estimated_as_the_job_plans_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the whole picture: on a coarse one a stronger finish would do. The plan's own lens is finer than this one, and
    the exact answer is of the job's own plan: of its spec and its picture.
    """
    values = ("image.pixels=256", "finish.process=best", "plan.hours=6")
    spec = resolve_spec(preset="recommended", overrides=values)
    plans: list[tuple[ResolvedJob, Array, Array | None, Planned]] = []

    def recorded(job: ResolvedJob, target: Array, *, whole: Array | None = None, on_progress: None = None) -> Planned:
        plans.append((job, target, whole, plan_for_picture(job, target, whole=whole)))
        return plans[-1][-1]

    for module in (estimating, kept_plans):
        monkeypatch.setattr(module, "plan_for_picture", recorded)
    found, exact = (estimated(spec, "camera", exactly=exactly) for exactly in (False, True))
    job, target, whole, planned = plans[1]
    read = read_picture(PICTURES / "camera.png", spec.image, rows=256, aspect=1.0)
    own = target_irradiance(read.linear, viewed_from="lens")
    np.testing.assert_array_equal(target, own)
    assert (job, whole) == (look_up(spec), None)
    assert planned.finishing is not None
    assert (found["exact"], exact["exact"]) == (False, True)
    for one, apart_db in ((found, 1.0), (exact, 1e-9)):
        assert one["psnr_db"] == pytest.approx(planned.score(planned.chosen).psnr_db, abs=apart_db)
        assert one["hours"] == pytest.approx(planned.chosen.hours, rel=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("picture", "preset", "values"),
    [
        ("astronaut", "draft", ("optics.light.kind=sun", "passes.1.pitch_mm=0.2")),
        ("camera", "paper", ("passes.1.pitch_mm=0.1", "passes.2.pitch_mm=0.05")),
    ],
)
def test_what_is_estimated_is_what_the_job_comes_to(
    tmp_path: Path, picture: str, preset: str, values: tuple[str, ...]
) -> None:
    spec = small("optics.width_mm=14", "optics.height_mm=14", "image.pixels=64", *values, preset=preset)
    found = estimated(spec, picture)
    unasked = ("caustic", "check", "report")
    report = run_job(tmp_path, PICTURES / f"{picture}.png", spec, without=unasked).report
    pixel_mm = spec.optics.screen_size_mm[0] / spec.image.pixels
    took_h = [row["time_s"] / 3600 for row in report["passes"]]
    assert found["relief_mm"] == pytest.approx(report["optics"]["relief_mm"], rel=0.05)
    assert found["max_slope_deg"] == pytest.approx(report["optics"]["max_slope_deg"], rel=0.15)
    assert found["hours"] == pytest.approx(sum(took_h), rel=0.2)
    assert [row["hours"] for row in found["passes"]] == pytest.approx(took_h, rel=0.3)
    assert found["blur_by"]["milling_mm"] == pytest.approx(report["as_milled"]["blur_px"] * pixel_mm, rel=0.3)
    assert found["psnr_db"] == pytest.approx(report["as_milled"]["psnr_db"], abs=2.0)  # words change every 6 dB
    assert (found["thickness_ok"], found["refusals"]) == (True, [])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("picture", "name", "values"),
    [
        ("camera", "caustic-as-finished.png", ("finish.process=felt", "finish.minutes=60")),
        ("astronaut", "caustic-as-milled.png", ("machine.profile=grbl-3018",)),
    ],
)
def test_the_wall_of_an_exact_estimate_is_the_one_of_its_job(
    tmp_path: Path, picture: str, name: str, values: tuple[str, ...]
) -> None:
    spec = resolve_spec(preset="recommended", overrides=("image.pixels=128", *values))
    job = run_job(tmp_path, PICTURES / f"{picture}.png", spec, without=("caustic", "check", "report"))
    compare_walls(estimated(spec, picture, exactly=True), job, name)


def compare_walls(found: dict[str, Any], job: StagedJob, name: str) -> None:
    """The wall of an estimate against the job's own picture of it, both against the target."""
    wall = light_of(base64.b64decode(found["wall"].partition(",")[2]))
    made, target = (resize(light_of(job.bytes(one)), wall.shape) for one in (name, "target.png"))
    assert np.corrcoef(wall.ravel(), made.ravel())[0, 1] >= 0.95
    assert psnr_db(wall, target) == pytest.approx(psnr_db(made, target), abs=1.0)


def light_of(packed: bytes) -> Array:
    """Of a picture of the wall: linear, white 1."""
    return srgb_to_linear(np.asarray(Image.open(io.BytesIO(packed))) / 255.0)


@pytest.mark.parametrize(("viewed_from", "pixels"), [("lens", 300), ("behind", 96)])
def test_the_wall_of_an_estimate_is_small_the_right_way_round_and_the_light_that_is_scored(
    viewed_from: str, pixels: int
) -> None:
    """Of `camera`, which no mirror leaves as it is; exposed by the target, as a job's pictures are."""
    spec = small(f"image.pixels={pixels}", f"optics.viewed_from={viewed_from}", "image.tone=linear")
    found = estimated(spec)
    wall = light_of(base64.b64decode(found["wall"].partition("data:image/png;base64,")[2]))
    assert wall.shape == (min(pixels, WALL_PIXELS),) * 2
    picture = read_picture(PICTURES / "camera.png", spec.image, rows=pixels, aspect=1.0).linear
    wanted = resize(picture, wall.shape) / picture.max()
    likeness = [np.corrcoef(wall.ravel(), one.ravel())[0, 1] for one in (wanted, wanted[:, ::-1], wanted[::-1])]
    assert likeness[0] > 0.8 > 0.6 > max(likeness[1:])
    assert wall.mean() == pytest.approx(wanted.mean(), rel=0.05)
    shown_db = psnr_db(wall, wanted)  # what is brighter than white is clipped, what is finer than the wall averaged
    assert shown_db >= found["psnr_db"] - 0.1
    assert shown_db <= found["psnr_db"] + 0.5 or pixels > WALL_PIXELS


def test_the_light_s_own_size_is_its_angle_times_the_throw() -> None:
    """A disc of diameter d has a standard deviation of d / 4 in each direction."""
    found = estimated(small("optics.light.kind=sun", "optics.light.size_deg=2.0"))
    disc_mm = math.radians(2.0) * 30.0
    least, most = (math.radians(2.0) * way_mm / 4 * math.sqrt(2) for way_mm in (30.0, 30.1 + found["relief_mm"]))
    assert least < found["blur_by"]["light_mm"] < most  # from somewhere between the lens's top and its bottom
    assert found["smallest_detail_mm"] > 2.35 * disc_mm / 4
    assert any("the light's own size" in sentence for sentence in found["warnings"])


def test_a_first_guess_says_what_is_lost_but_not_how_much() -> None:
    """What a coarse lens loses in valleys is decibels off: the job's own lens says how many."""
    (sentence,) = [one for one in estimated(small())["warnings"] if "narrow valleys" in one]
    assert sentence.endswith("keeps more of it")


def test_the_picture_is_decoded_once_for_all_that_is_asked_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A large photograph takes longer to decode than all the rest of an estimate."""
    seen: list[Path] = []

    def counted(path: Path, limits: PictureLimits, name: str) -> Image.Image:
        seen.append(path)
        return decoding.decode_picture(path, limits, name)

    for module in (estimating, reading):
        monkeypatch.setattr(module, "decode_picture", counted)
    estimated(small())
    assert len(seen) == 1


def test_the_block_may_be_just_so_thin() -> None:
    depth_mm = estimated(small())["relief_mm"] + 0.1  # and the skim
    for more_mm, is_enough in ((0.01, True), (-0.01, False)):
        found = estimated(small(f"stock.thickness_mm={depth_mm + 2.0 + more_mm}"))
        assert found["thickness_ok"] is is_enough
        assert bool(found["refusals"]) is not is_enough


def test_half_the_pitch_takes_twice_the_time_of_the_rows() -> None:
    hours = [estimated(small(f"passes.1.pitch_mm={pitch}"))["passes"][1]["hours"] for pitch in (0.2, 0.1, 0.05)]
    assert hours[1] / hours[0] == pytest.approx(2.0, rel=0.15)
    assert hours[2] / hours[1] == pytest.approx(2.0, rel=0.15)


def test_a_slower_machine_takes_longer_and_a_wider_step_blurs_more() -> None:
    usual, slow = (estimated(small(*values)) for values in ((), ("machine.lines_per_s=20", "machine.step_mm=0.02")))
    assert slow["hours"] > 1.2 * usual["hours"]
    assert slow["blur_by"]["milling_mm"] > 1.2 * usual["blur_by"]["milling_mm"]


@pytest.mark.thorough
def test_passes_that_are_still_to_be_planned_are_planned() -> None:
    found = estimated(small(preset="recommended"))
    assert found["planned"] is True
    assert [row["name"] for row in found["spec"]["passes"]] == [row["name"] for row in found["passes"]]
    assert len(found["passes"]) >= 1
    assert found["hours"] > 0


def test_what_an_estimate_says_can_be_said_in_another_language() -> None:
    found = estimated(
        small("optics.throw_mm=12", "image.pixels=2000", "stock.cut_out.radius_mm=1", "passes.0.corner_radius_mm=0")
    )
    assert len(found["warnings"]) > 2
    assert untold(found, "tool") == []


def test_what_will_not_fit_is_said_before() -> None:
    found = estimated(small("passes.1.flute_length_mm=0.05"))
    assert any("flute_length_mm" in row["field"] + row["detail"] for row in found["refusals"])


@pytest.mark.parametrize(
    ("key", "given"),
    [
        ("optics.throw_mm", ("optics.throw_mm=3",)),
        ("stock.thickness_mm", ("stock.thickness_mm=2.5",)),
        ("optics.width_mm", ("machine.travel_mm=[20, 300, 80]",)),
        ("passes.1.flute_length_mm", ("passes.1.flute_length_mm=0.45",)),
    ],
)
def test_a_value_that_is_offered_in_place_of_a_refused_one_does(key: str, given: tuple[str, ...]) -> None:
    def refused(*values: str) -> dict[str, Any]:
        try:
            rows = estimated(small(*values))["refusals"]
        except SpecError as error:
            rows = error.rows()
        return {row["field"]: row["use"] for row in rows if "use" in row}

    use = refused(*given)[f"spec.{key}"]
    assert f"spec.{key}" not in refused(*given, f"{key}={use}")


def test_a_picture_of_one_tone_is_refused(tmp_path: Path) -> None:
    """Its lens is flat: it was called recognisable, with details of atoms' size."""
    Image.new("L", (40, 40), 255).save(path := tmp_path / "white.png")
    with pytest.raises(PictureError, match="one tone"):
        estimate(look_up(small()), path, limits=OWN_PICTURE, name="white.png")


@pytest.mark.parametrize("size", [(100, 100), (150, 50), (40, 110)])
def test_a_coarse_picture_has_the_form_of_the_fine_one(size: tuple[int, int]) -> None:
    spec = resolve_spec(overrides=(f"optics.width_mm={size[0]}", f"optics.height_mm={size[1]}"))
    coarse = coarse_spec(spec)
    assert max(coarse.image.pixels, coarse.pixel_rows) == pytest.approx(PIXELS, abs=1)
    assert coarse.pixel_rows / coarse.image.pixels == pytest.approx(size[1] / size[0], rel=0.05)


def test_a_small_picture_stays_as_it_is() -> None:
    spec = small("image.pixels=64")
    assert coarse_spec(spec) == spec


@pytest.mark.thorough
def test_nothing_of_the_answer_depends_on_the_pictures_place(tmp_path: Path) -> None:
    twin: Callable[[Path], dict[str, Any]] = lambda path: estimate(  # noqa: E731
        look_up(small()), path, limits=OWN_PICTURE, name="picture"
    )
    (tmp_path / "copy").write_bytes((PICTURES / "logo.png").read_bytes())
    assert twin(tmp_path / "copy") == twin(PICTURES / "logo.png")
