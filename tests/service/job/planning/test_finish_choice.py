"""A finish is planned with ball and pitch, where it helps and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cam.planning.planner import Goal
from optics.finish import Finish
from optics.heightfield import Array
from optics.irradiance import target_irradiance
from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.planning.finish_choice import FinishedPlan, find_best, trust_nearest
from service.job.planning.finished_light import FinishedLight
from service.job.planning.plan import Planned
from service.job.planning.plan_report import plan_figures
from service.job.planning.planner import plan_for_picture
from service.job.planning.predicted_light import PictureLight
from service.job.spec.loading import resolve_job, resolve_spec
from service.job.spec.resolve import with_plan

SIZE = (
    "optics.width_mm=30", "optics.height_mm=30", "optics.throw_mm=60", "image.pixels=64",
    "optics.light.spectrum=monochromatic",  # rows and finishes are what is looked at
)  # fmt: skip
ROUGH, FINE = ("machine.z_noise_mm=0.002",), ("machine.z_noise_mm=0.0", "machine.step_mm=0.00001")


def target_of(pixels: int) -> Array:
    """Return stripes and a disc of soft edges: no pad reaches the creases that sharp ones ask for."""
    y, x = np.mgrid[0:pixels, 0:pixels] / pixels
    disc = 1.0 / (1.0 + np.exp((np.hypot(x - 0.4, y - 0.6) - 0.25) / 0.02))
    picture = 0.3 + 0.4 * disc + 0.2 * np.sin(2 * np.pi * 4 * x)
    return target_irradiance(np.clip(picture, 0, 1), viewed_from="lens")


def planned(*overrides: str, whole: Array | None = None, target: Array | None = None) -> Planned:
    job = resolve_job(preset="recommended", overrides=[*SIZE, *overrides])
    return plan_for_picture(job, target_of(64) if target is None else target, whole=whole)


@pytest.fixture(scope="module")
def best_on_a_rough_mill() -> Planned:
    return planned("finish.process=best", *ROUGH)


def test_a_rough_mill_gets_a_finish_that_shows_more(best_on_a_rough_mill: Planned) -> None:
    """Rows off by 2 um blur what a finish would level."""
    assert best_on_a_rough_mill.finishing is not None
    assert best_on_a_rough_mill.unfinished is not None
    assert best_on_a_rough_mill.chosen.psnr_db > best_on_a_rough_mill.unfinished.chosen.psnr_db + 1.0


def test_rows_run_where_their_stripes_are_seen_less(best_on_a_rough_mill: Planned) -> None:
    """Light that is drawn together across its lines shows stripes across them more: a turned picture turns the rows."""
    turned = planned("finish.process=best", *ROUGH, target=np.ascontiguousarray(target_of(64).T))
    assert {plan.chosen.finish.direction for plan in (best_on_a_rough_mill, turned)} == {"x", "y"}


@pytest.mark.thorough
def test_a_finish_that_makes_it_worse_is_not_planned() -> None:
    """A mill without errors leaves nothing that is worth levelling."""
    plan = planned("finish.process=best", *FINE)
    assert plan.finishing is None
    assert plan.finish_table() == {"process": "none"}


@pytest.mark.thorough
def test_a_process_that_is_asked_for_is_planned_even_where_it_makes_the_picture_worse() -> None:
    plan = planned("finish.process=felt", *FINE)
    assert plan.finishing is not None
    assert plan.finishing.process == "felt"


@pytest.mark.parametrize("first", [0, 1])
def test_of_finishes_alike_the_one_that_looks_most_like_the_picture_is_taken(
    best_on_a_rough_mill: Planned, first: int
) -> None:
    plan, like = best_on_a_rough_mill.plan, best_on_a_rough_mill.finishing
    assert like is not None
    milled = PictureLight(target_of(64), best_on_a_rough_mill.light.bench)
    milled.lenses = best_on_a_rough_mill.light.lenses
    levelled_and_striped = [
        FinishedPlan(plan=plan, finishing=like, light=FinishedLight(milled, Finish(k0_rad_per_mm=k0, order=1.0)))
        for k0 in (1.5, 10.0)
    ]
    taken = find_best(levelled_and_striped[first:] + levelled_and_striped[:first], Goal())
    assert taken is levelled_and_striped[0]


@pytest.mark.thorough
def test_a_finish_of_ones_own_figures_is_kept_whatever_it_does() -> None:
    plan = planned("finish.k0_rad_per_mm=2.0", "finish.order=1", "finish.depth_um=20", *FINE)
    assert plan.finishing is not None
    assert plan.finishing.finish.k0_rad_per_mm == 2.0
    assert 0.5 < plan_figures(plan)["contact_share"] < 1.0


def test_passes_leave_room_for_the_tool_of_a_finish() -> None:
    """A ball of R 0.5 would show 0.5 dB more, but the wall beside its rims leaves no tool room."""
    plan = planned("finish.k0_rad_per_mm=6.0", "finish.order=1", "finish.depth_um=7", "finish.pad_mm=10", *ROUGH)
    assert plan.chosen.finish.radius_mm >= Finish(k0_rad_per_mm=6.0, order=1.0).reach_mm
    assert plan.rim_room is not None and plan.rim_room.is_reached


def test_where_no_pass_leaves_room_a_given_finish_stays_with_a_warning() -> None:
    words = "the tool of the finish does not reach the rims"
    own = ("finish.k0_rad_per_mm=1.2", "finish.order=1", "finish.depth_um=20", "stock.margin_mm=4")
    plan = planned(*own, *ROUGH)
    assert plan.finishing is not None and plan.rim_room is not None and not plan.rim_room.is_reached
    (warning,) = (one for one in plan_figures(plan)["warnings"] if words in one)
    assert isinstance(warning, Phrase)


def test_what_one_tool_does_not_reach_is_no_guess_for_another(best_on_a_rough_mill: Planned) -> None:
    like = best_on_a_rough_mill.finishing
    assert like is not None
    milled = PictureLight(target_of(64), best_on_a_rough_mill.light.bench)
    ways = [
        (replace(like, process=process), FinishedLight(milled, Finish(k0_rad_per_mm=k0, order=1.0)))
        for process, k0 in (("felt", 2.0), ("felt", 2.2), ("felt", 2.5), ("felt", 3.0), ("sanding", 2.0))
    ]
    ways[0][1].contact_share, ways[3][1].contact_share = 0.5, 0.9
    trust_nearest(ways, {0, 3})
    assert [light.contact_share for _, light in ways] == [0.5, 0.5, 0.9, 0.9, None]


@pytest.mark.thorough
@pytest.mark.parametrize("process", ["felt", "lacquer"])
def test_the_best_finish_shows_no_less_than_any(best_on_a_rough_mill: Planned, process: str) -> None:
    """A pad that loses touch on one lens is no reason to leave out a film."""
    alone = planned(f"finish.process={process}", *ROUGH)
    assert best_on_a_rough_mill.chosen.psnr_db > alone.chosen.psnr_db - 0.3


def test_the_job_gets_the_finish_of_its_plan(best_on_a_rough_mill: Planned) -> None:
    """All figures, so that nothing of the library is asked again."""
    spec = resolve_spec(preset="recommended", overrides=[*SIZE, "finish.process=best", *ROUGH])
    done = with_plan(spec, {"plan": plan_figures(best_on_a_rough_mill)})
    assert best_on_a_rough_mill.finishing is not None
    assert done.finish.process == best_on_a_rough_mill.finishing.process
    assert done.finish.k0_rad_per_mm == best_on_a_rough_mill.finishing.finish.k0_rad_per_mm
    assert done.finish.minutes == best_on_a_rough_mill.finishing.minutes


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["finish.process=best"], "finish.process"),
        (["finish.process=sandpaper"], "finish.process"),
        (["finish.k0_rad_per_mm=3"], "finish.order"),
        (["finish.minutes=3"], "finish.minutes"),
    ],
)
def test_a_finish_that_says_too_little_or_too_much_is_refused(overrides: list[str], key: str) -> None:
    with pytest.raises(SpecError) as error:
        resolve_spec(preset="draft", overrides=overrides)
    assert [place for place, _ in error.value.problems] == [key]
