"""Plans for lenses that are what they are: valleys that a big ball cannot reach are cleared by a small one."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from cam.passes import ball_pass
from cam.planning.planner import Marks
from cam.planning.row_slopes import RowSlopes, SlopeSpread
from optics.caustic import simulate_caustic
from optics.heightfield import Heightfield
from service.cli.plan import spec_fragment, table
from service.job.planning.plan import Planned
from service.job.planning.plan_report import plan_figures
from service.job.planning.planner import plan_for_lens
from service.job.planning.predicted_light import PictureLight
from service.job.planning.sentences import reasons
from service.job.report.figures import plan
from service.job.report.figures.base import png_bytes
from service.job.report.figures.plan import plan_png
from service.job.spec.lens_task import bench_of
from service.job.spec.loading import resolve_spec
from service.job.spec.model import JobSpec
from service.job.spec.resolve import cam_passes_of, look_up
from service.wording import ball

SIDE, PIXELS = 20.0, 48
GOOD_MILL = ("machine.step_mm=0.0005", "machine.z_noise_mm=0.0001", "machine.whole_steps=true")
SIZE = (f"optics.width_mm={SIDE}", f"optics.height_mm={SIDE}", "optics.throw_mm=60", f"image.pixels={PIXELS}")
SPEC = resolve_spec(preset="recommended", overrides=[*SIZE, *GOOD_MILL, "plan.psnr_db=33"])


def lens(valley_mm: float) -> Heightfield:
    """Soft hills, and one narrow valley of that depth across a third of them."""
    x, y = np.meshgrid(*(np.linspace(0.0, SIDE, 161),) * 2)
    across = (x - 0.4 * y - 0.3 * SIDE) / np.hypot(1.0, 0.4)
    z = 0.15 * np.sin(2 * np.pi * x / 18) * np.sin(2 * np.pi * y / 23)
    z = z - valley_mm * np.exp(-((across / 0.3) ** 2) / 2 - ((y - SIDE / 2) / 3.3) ** 2 / 2)
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE, height_mm=SIDE)


def planned(one: Heightfield, spec: JobSpec = SPEC) -> Planned:
    """For the light that the lens itself would show."""
    own = simulate_caustic(one, bench_of(spec), pixels=(PIXELS, PIXELS)).irradiance
    return plan_for_lens(look_up(spec), one, own / own.mean())


@pytest.fixture(scope="module")
def sharp() -> Planned:
    return planned(lens(0.12))


@pytest.mark.thorough
def test_a_valley_that_the_ball_cannot_reach_gets_a_pass_of_its_own(sharp: Planned) -> None:
    """Short beside one of the whole lens with that ball at that pitch, and worth it."""
    chosen = sharp.chosen
    assert chosen.rest is not None
    assert chosen.rest.spec.radius_mm < chosen.finish.radius_mm
    assert chosen.rest.extent.length_mm < 0.25 * SIDE**2 / chosen.rest.spec.pitch_mm
    without = replace(chosen.marks, rest=None)
    assert chosen.psnr_db > sharp.light.aimed_db(without) + 0.3
    assert chosen.psnr_db <= sharp.light.perfect_db(chosen.marks.smallest_mm)


def test_it_is_said_why_and_shown_everywhere(sharp: Planned) -> None:
    told = json.loads(json.dumps(plan_figures(sharp)))
    rest = told["rest"]
    assert rest["radius_mm"] == sharp.chosen.rest.spec.radius_mm
    assert rest["area_share"] == pytest.approx(rest["area_mm2"] / SIDE**2)
    assert rest["hours"] == pytest.approx(told["hours_by_pass"][-1])
    assert rest["gain_db"] > 0.3
    (sentence,) = [one for one in reasons(sharp) if "rest pass" in one]
    assert f"a ball {ball(rest['radius_mm'])} in rows" in sentence
    assert f"gains {rest['gain_db']:.1f} dB" in sentence
    head, *rows = table(sharp)
    assert "REST" in head
    (marked,) = [row for row in rows if row.startswith("->")]
    assert f"R{rest['radius_mm']:g} / {rest['pitch_mm']:g}" in marked
    assert [row["rest"] is not None for row in told["candidates"]] == [one.rest is not None for one in sharp.plan.front]


@pytest.mark.parametrize("shown", [1, 3])
def test_no_word_of_the_picture_is_cut_or_covers_another(
    sharp: Planned, shown: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rest pass makes the longest captions. With a single plan the figure has two pictures."""
    drawn: list[Figure] = []
    monkeypatch.setattr(plan, "png_bytes", lambda figure: (drawn.append(figure), png_bytes(figure))[1])
    monkeypatch.setattr(plan, "finish_words", lambda _: "ball R 0.75 (Ø 1.5 mm), pitch 0.0125 mm, rows along Y")
    front = (sharp.chosen,) if shown == 1 else sharp.plan.front
    mill = replace(sharp.machine, name="roland-mdx-40a", z_noise_mm=0.0015)
    some = replace(sharp, machine=mill, plan=replace(sharp.plan, front=front))
    assert plan_png(some, viewed_from="lens").startswith(b"\x89PNG")
    (figure,) = drawn
    words = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text()]
    boxes = [text.get_window_extent() for text in words]
    for text, box in zip(words, boxes, strict=True):
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, text.get_text()
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1, text.get_text()
    assert not [(one, other) for one, other in combinations(boxes, 2) if one.overlaps(other)]


def test_its_spec_is_the_plan(sharp: Planned, tmp_path: object) -> None:
    whole = resolve_spec(base={**SPEC.plain(), "passes": sharp.fragment()["passes"]})
    assert cam_passes_of(whole) == sharp.chosen.passes
    assert whole.passes[-1].where == "rest"
    assert 'where = "rest"' in spec_fragment(sharp, SPEC)


@pytest.mark.thorough
def test_where_every_ball_fits_no_rest_pass_is_planned() -> None:
    found = planned(lens(0.0))
    assert found.light.fillings == {}
    assert all(one.rest is None for one in found.plan.front)
    assert "REST" not in next(iter(table(found)))
    assert not any("rest pass" in sentence for sentence in reasons(found))


@pytest.mark.thorough
def test_what_is_not_worth_the_time_is_left_and_said() -> None:
    """On a mill whose noise blurs more than the valley shows."""
    spec = resolve_spec(preset="recommended", overrides=[*SIZE, "machine.z_noise_mm=0.004"])
    found = planned(lens(0.05), spec)
    assert found.light.fillings
    assert found.chosen.rest is None
    assert any("show hardly more" in sentence for sentence in reasons(found))


def unmarked() -> RowSlopes:
    none = SlopeSpread(slope=np.zeros(1), share=np.ones(1))
    return RowSlopes(across=none, along=none)


def test_rows_that_leave_no_mark_show_the_lens_as_the_smaller_ball_leaves_it(sharp: Planned) -> None:
    light: PictureLight = sharp.light
    big, small = sharp.chosen.finish, sharp.chosen.rest.spec
    marks = Marks(spec=big, slopes=unmarked(), rest=Marks(spec=small, slopes=unmarked()))
    alone = replace(marks, rest=None)
    assert light.aimed_db(marks) == pytest.approx(light.perfect_db(small.radius_mm), abs=1e-3)
    assert light.aimed_db(alone) == pytest.approx(light.perfect_db(big.radius_mm), abs=1e-3)
    assert light.psnr_db(marks) == pytest.approx(light.aimed_db(marks), abs=1e-3)


@pytest.mark.parametrize("strategy", ["raster", "contour"])
def test_a_guess_with_a_rest_pass_is_near_the_picture_itself(sharp: Planned, strategy: str) -> None:
    """Contours blur each place its own way: the guess counts that, the picture their mean; 1.5 dB apart at most."""
    chosen = sharp.chosen
    marks = replace(chosen.marks, spec=replace(chosen.finish, strategy=strategy, pitch_mm=0.28))
    assert sharp.light.psnr_db(marks) == pytest.approx(sharp.light.aimed_db(marks), abs=1.5)


def test_marks_of_the_rest_pass_blur_only_the_light_of_the_valleys(sharp: Planned) -> None:
    """A rest pass as coarse as a rake changes as much of the picture as comes through the valleys."""
    light, chosen = sharp.light, sharp.chosen
    rough = ball_pass("rest", radius_mm=chosen.rest.spec.radius_mm, pitch_mm=0.2, stock_to_leave_mm=0, step_down_mm=1)
    spread = SlopeSpread(slope=np.array([-0.2, 0.2]), share=np.array([0.5, 0.5]))
    raked = Marks(spec=rough, slopes=replace(unmarked(), across=spread))
    plain, coarse = (
        light.picture(Marks(spec=chosen.finish, slopes=unmarked(), rest=rest))
        for rest in (replace(raked, slopes=unmarked()), raked)
    )
    through = 1.0 - light.lenses[chosen.finish.radius_mm].valleys.shares_past
    moved = np.abs(coarse - plain).sum() / 2
    assert moved < 1.05 * (through * plain).sum() + 0.02 * plain.sum()
    assert moved > 0.2 * (through * plain).sum()
