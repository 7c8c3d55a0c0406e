"""Laws of planning: what fits, what an hour buys, and whether the hours are true."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import ceil, inf, log2, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.as_milled.surface import MilledSurface
from cam.duration import DurationModel, Kinematics
from cam.materials import PMMA
from cam.passes import PAPER_PASSES, PassSpec, Stock, ball_pass
from cam.planning.pass_time import LensForm
from cam.planning.planner import DOUBLING_DB, Goal, Marks, NoPlanError, Plan, choose, find_candidates, time_by_lens
from cam.planning.rough import Roughing
from cam.planning.row_slopes import RowSlopes
from cam.planning.sampled_time import first_pass_s, rows_s
from cam.planning.shop import Shop
from cam.posts.post import Digits
from cam.program import pass_paths
from cam.rows.rounding import Rounding, on_raster
from cam.surface.stock_grid import StockGrid
from cam.surface.tool_surface import ToolSurface
from cam.tools import Tool
from optics.heightfield import Heightfield
from tests.cam import checks
from tests.cam.balls import tool
from tests.cam.programs import make_plan, row_tracks

MILL = Kinematics(
    max_rate_mm_per_min=(5000.0, 5000.0, 1500.0),
    acceleration_mm_per_s2=(400.0, 400.0, 200.0),
    junction_deviation_mm=0.01,
    planner_blocks=16,
    lines_per_s=400.0,
)
SIDE_MM = 20.0


def shop(*tools: Tool, noise_mm: float = 0.0005, step_mm: float = 0.002, margin_mm: float = 14.0) -> Shop:
    return Shop(
        tools=tools, material=PMMA, mill=MILL, spindle_rpm=(8000.0, 30_000.0), step_mm=step_mm, noise_mm=noise_mm,
        margin_mm=margin_mm,
    )  # fmt: skip


def bumps(height_mm: float = 0.2) -> Heightfield:
    axis = np.linspace(0.0, SIDE_MM, 81)
    z = height_mm * np.sin(2 * np.pi * axis / 9.0)[None, :] * np.sin(2 * np.pi * axis / 7.0)[:, None]
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE_MM, height_mm=SIDE_MM)


class Blur:
    """Light that only knows how far slopes send it: less blur, better picture."""

    def psnr_db(self, marks: Marks) -> float:
        return -20 * np.log10(self.blur_mm(marks.slopes)) - 0.1 * marks.radius_mm

    aimed_db = psnr_db

    def settle(self, several: Iterable[Marks]) -> None:
        """Its lenses are what they are."""

    def blur_mm(self, slopes: RowSlopes) -> float:
        return 49.0 * sqrt(slopes.across.rms**2 + slopes.along.rms**2)


@pytest.fixture(scope="module")
def plan() -> Plan:
    return planned(Goal())


def planned(goal: Goal, *tools: Tool, **changes: float) -> Plan:
    given = tools or tuple(tool(radius) for radius in (0.5, 1.5, 3.0, 4.0))
    form = LensForm.of(bumps())
    return make_plan(shop(*given, **changes), {one.radius_mm: form for one in given}, Blur(), goal, fillings={})


def test_a_first_pass_leaves_less_where_that_spares_the_finish_its_layers() -> None:
    roughing = Roughing(form=LensForm.of(bumps(1.0)), shop=shop(tool(6.0), margin_mm=16.0))
    for step_down_mm, spared in ((0.394, True), (0.2, False), (1.0, False)):
        finish = ball_pass("finish", radius_mm=2.0, pitch_mm=0.05, stock_to_leave_mm=0.0, step_down_mm=step_down_mm)
        before = roughing.plan_before(finish)
        assert before is not None
        assert before.depth_mm <= finish.layer_mm
        assert (before.passes[0].stock_to_leave_mm < 0.2) is spared
        assert len(before.passes) == (2 if step_down_mm == 0.2 else 1)


@pytest.mark.thorough
def test_what_is_flat_roughs_deep_lenses_and_the_hours_after_it_are_true() -> None:
    """A shallow lens is not worth another tool; after a deep one the finish has stairs to take off."""
    mill, margin_mm = checks.MILL, 14.0
    tools = (tool(3.0), replace(tool(3.0), name="flat", corner_radius_mm=0.0))
    where = replace(shop(*tools, margin_mm=margin_mm), mill=mill)
    finish = ball_pass("finish", radius_mm=3.0, pitch_mm=0.3, stock_to_leave_mm=0.0, step_down_mm=0.5)
    axis = np.linspace(0.0, 60.0, 121)
    z = 6 * np.sin(2 * np.pi * axis / 70.0)[None, :] * np.sin(2 * np.pi * axis / 80.0)[:, None]
    deep = Heightfield.on_aperture(z - z.max() - 16.0, width_mm=60.0, height_mm=60.0)
    shallow = Roughing(form=LensForm.of(bumps()), shop=where).plan_before(finish)
    assert shallow is not None and shallow.passes[0].is_ball
    form = LensForm.of(deep)
    before = Roughing(form=form, shop=where).plan_before(finish)
    assert before is not None and not before.passes[0].is_ball
    stock = Stock(width_mm=60.0, height_mm=60.0, thickness_mm=40.0, margin_mm=margin_mm)
    first = checks.checked(
        deep, replace(before.passes[0], max_rate_mm_per_min=mill.max_rate_mm_per_min), stock, StockGrid.block(stock)
    )
    second = checks.checked(deep, finish, stock, first.stock_top)
    assert first.ok and second.ok
    told_s = before.seconds[0] + rows_s(form, finish, mill) + before.layers_s(form, finish, where)
    assert told_s == pytest.approx(first.time_s + second.time_s, rel=0.04)


@pytest.mark.parametrize("height_mm", [0.05, 0.3])
def test_hours_that_are_found_quickly_are_nearly_those_of_all_moves(height_mm: float) -> None:
    tools = (*(tool(radius) for radius in (1.0, 2.0, 3.0)), replace(tool(3.0), name="flat", corner_radius_mm=0.0))
    form, where = LensForm.of(bumps(height_mm)), shop(*tools)
    lenses = {one.radius_mm: form for one in where.balls}
    quick, full = (find_candidates(where, lenses, Blur(), fillings={}, quickly=one)[0] for one in (True, False))
    assert [one.finish for one in quick] == [one.finish for one in full]
    assert [one.hours for one in quick] == pytest.approx([one.hours for one in full], rel=0.1, abs=2 / 60)


def test_no_doubling_of_the_time_gains_more_than_it_is_worth(plan: Plan) -> None:
    chosen = plan.chosen
    for one in plan.front:
        assert one.psnr_db - chosen.psnr_db <= DOUBLING_DB * log2(one.hours / chosen.hours) + 1e-9


def test_hours_are_those_of_the_lens_itself_and_the_choice_moves_with_them(plan: Plan) -> None:
    """A lens with fine detail that the coarse one lacks takes longer, and what fitted in the hours no longer does."""
    coarse, fine = LensForm.of(bumps()), LensForm.of(bumps(1.0))
    shop_of_all = shop(*(tool(radius) for radius in (0.5, 1.5, 3.0, 4.0)))
    timed = time_by_lens(plan, fine, Goal(), guessed=coarse, shop=shop_of_all)
    assert (timed.chosen.passes, timed.chosen.marks) == (plan.chosen.passes, plan.chosen.marks)
    rough, finish = timed.chosen.passes[0], timed.chosen.finish
    assert timed.chosen.seconds[0] == first_pass_s(fine, rough, MILL)
    more_s = rows_s(fine, finish, MILL) - rows_s(coarse, finish, MILL)
    assert timed.chosen.seconds[-1] == pytest.approx(plan.chosen.seconds[-1] + more_s)
    goal = Goal(hours=1.001 * plan.chosen.hours)
    kept = replace(plan, chosen=choose(plan.front, goal)[0])
    moved = time_by_lens(kept, fine, goal, guessed=coarse, shop=shop_of_all)
    assert moved.met and moved.chosen.hours <= goal.hours < timed.chosen.hours
    assert moved.chosen.finish != kept.chosen.finish


@settings(max_examples=60)
@given(hours=st.floats(0.001, 50.0), more=st.floats(1.0, 4.0))
def test_hours_are_kept_and_more_of_them_never_make_a_worse_picture(plan: Plan, hours: float, more: float) -> None:
    first, met = choose(plan.front, Goal(hours=hours))
    second, _ = choose(plan.front, Goal(hours=hours * more))
    assert met == (hours >= plan.quickest.hours)
    assert first.hours <= hours or not met
    assert second.psnr_db >= first.psnr_db


@settings(max_examples=60)
@given(blur_mm=st.floats(0.01, 3.0), psnr_db=st.floats(-5.0, 20.0))
def test_a_wanted_blur_or_picture_is_met_or_said_to_be_missed(plan: Plan, blur_mm: float, psnr_db: float) -> None:
    sharp, met = choose(plan.front, Goal(blur_mm=blur_mm))
    assert (sharp.blur_mm <= blur_mm) == met
    assert met or sharp.blur_mm == min(one.blur_mm for one in plan.front)
    good, met = choose(plan.front, Goal(psnr_db=psnr_db))
    assert (good.psnr_db >= psnr_db) == met


def test_the_front_gains_with_every_hour(plan: Plan) -> None:
    hours, psnr = ([getattr(one, key) for one in plan.front] for key in ("hours", "psnr_db"))
    assert hours == sorted(hours)
    assert psnr == sorted(psnr)


def test_every_plan_ends_with_the_one_pass_that_leaves_nothing(plan: Plan) -> None:
    for one in plan.front:
        assert [spec.finishes for spec in one.passes] == [False] * (len(one.passes) - 1) + [True]
        assert len(one.passes) == len(one.seconds)
        left = [spec.stock_to_leave_mm for spec in one.passes]
        assert left == sorted(left, reverse=True)
        assert one.passes[0].radius_mm >= one.finish.radius_mm


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (tool(7.0), "margin_mm = 15"),
        (tool(1.0, stick_out_mm=0.4, flute_length_mm=0.4), "sticks out 0.4 mm"),
        (tool(1.0, shank_radius_mm=8.0, flute_length_mm=1.0), "shank"),
    ],
)
def test_a_tool_that_cannot_is_not_chosen_and_said_why(fault: Tool, words: str) -> None:
    found = planned(Goal(), fault, tool(3.0))
    assert found.chosen.tool.name == "r3"
    assert [name for name, _ in found.left_out] == [fault.name]
    assert words in found.left_out[0][1]
    assert all(spec.radius_mm != fault.radius_mm for one in found.front for spec in one.passes[-1:])


def test_a_ball_that_the_valleys_do_not_admit_is_not_chosen() -> None:
    """Concave radii go down to 1.2 mm here."""
    form = LensForm.of(bumps(1.0))
    found = make_plan(shop(tool(0.5), tool(4.0)), {0.5: form, 4.0: form}, Blur(), Goal(), fillings={})
    assert found.chosen.tool.name == "r0.5"
    assert found.left_out[0][0] == "r4"
    assert "% of the lens" in found.left_out[0][1]
    with pytest.raises(NoPlanError, match="r4"):
        make_plan(shop(tool(4.0)), {4.0: form}, Blur(), Goal(), fillings={})


@pytest.mark.parametrize("radius_mm", [0.5, 3.0])
def test_rows_take_as_long_as_their_program(radius_mm: float) -> None:
    """Within 5 % of the planner's model of the written moves."""
    spec = ball_pass("finish", radius_mm=radius_mm, pitch_mm=0.25, stock_to_leave_mm=0.0, step_down_mm=50.0)
    lens = bumps(0.05)  # as curved as a photograph's
    assert rows_s(LensForm.of(lens), spec, MILL) == pytest.approx(_measured_s(lens, spec, top_mm=-20.0), rel=0.05)


@pytest.mark.parametrize("hollow_mm", [3.3, 4.0])
def test_a_crease_that_just_holds_the_ball_takes_its_tip_no_time(hollow_mm: float) -> None:
    """Two slopes that meet in a hollow: all of its chords are short, and there are few of them. Within 5 %."""
    spec = ball_pass("finish", radius_mm=3.0, pitch_mm=0.25, stock_to_leave_mm=0.0, step_down_mm=50.0)
    lens = crease(hollow_mm, slope=0.3)
    assert rows_s(LensForm.of(lens), spec, MILL) == pytest.approx(_measured_s(lens, spec, top_mm=-20.0), rel=0.05)


def crease(hollow_mm: float, slope: float) -> Heightfield:
    """Two planes that meet along Y in an arc of this radius."""
    x = np.abs(np.linspace(-SIDE_MM / 2, SIDE_MM / 2, 401))
    half_mm = hollow_mm * slope / np.hypot(1.0, slope)
    arc = hollow_mm - np.sqrt(hollow_mm**2 - np.minimum(x, half_mm) ** 2)
    z = np.tile(arc + slope * np.maximum(x - half_mm, 0.0), (401, 1))
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE_MM, height_mm=SIDE_MM)


def test_rows_on_a_slow_link_take_as_long_as_the_lines_that_the_raster_leaves_of_them() -> None:
    """Steps of 4 micrometres leave out a third of the vertices here: without them a sixth too much."""
    spec = ball_pass("finish", radius_mm=3.0, pitch_mm=0.25, stock_to_leave_mm=0.0, step_down_mm=50.0)
    lens, slow, digits = bumps(0.05), replace(MILL, lines_per_s=60.0), Digits(xy_mm=0.004, z_mm=0.004)
    measured_s = _measured_s(lens, spec, top_mm=-20.0, mill=slow, rounding=Rounding(digits=digits, pitch_mm=0.25))
    assert rows_s(LensForm.of(lens), spec, slow, digits) == pytest.approx(measured_s, rel=0.03)


@pytest.mark.parametrize("lines_per_s", [35.0, 400.0])
def test_layers_take_as_long_as_their_program(lines_per_s: float) -> None:
    """On a part this small entries, walls and turns count for most; on a slow link the points of turns."""
    spec = ball_pass("rough", radius_mm=3.0, pitch_mm=1.0, stock_to_leave_mm=0.2, step_down_mm=0.5)
    lens, mill = bumps(0.6), replace(MILL, lines_per_s=lines_per_s)
    measured_s = _measured_s(lens, spec, top_mm=0.0, mill=mill)
    assert first_pass_s(LensForm.of(lens), spec, mill) == pytest.approx(measured_s, rel=0.03)


def _measured_s(
    lens: Heightfield, spec: PassSpec, *, top_mm: float, mill: Kinematics = MILL, rounding: Rounding | None = None
) -> float:
    stock = Stock(width_mm=SIDE_MM, height_mm=SIDE_MM, thickness_mm=30.0, margin_mm=8.0)
    block = StockGrid.block(stock)
    top = replace(block, top_mm=np.full_like(block.top_mm, top_mm))
    model, last, line = DurationModel(mill), np.array([0.0, 0.0, 5.0]), 0
    paths = pass_paths(lens, spec, stock, stock_top=top)
    for path in paths if rounding is None else on_raster(paths, rounding):
        points = np.vstack([last, path.points_mm])
        count, feed = len(points) - 1, path.feed_mm_per_min
        model.add(
            Moves(
                points, np.full(count, feed is None), np.full(count, inf if feed is None else feed),
                np.arange(line + 1, line + count + 1), np.full(count, -1.0),
            )
        )  # fmt: skip
        last, line = points[-1], line + count
    return model.seconds


class Moves:
    """A batch as `cam.duration` takes it."""

    def __init__(self, points, rapid, feed, line, pause) -> None:  # type: ignore[no-untyped-def]
        self.points_mm, self.is_rapid, self.feed_mm_per_min, self.line, self.pause_s = points, rapid, feed, line, pause

    def __len__(self) -> int:
        return len(self.line)


def valley(bend_per_mm: float) -> Heightfield:
    """A cylinder along X; positive: a hollow."""
    y = np.linspace(0.0, SIDE_MM, 81) - SIDE_MM / 2
    z = np.tile((bend_per_mm * y**2 / 2)[:, None], (1, 81))
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE_MM, height_mm=SIDE_MM)


@pytest.mark.parametrize("bend_per_mm", [-0.02, 0.0, 0.02])
def test_rows_leave_the_same_slopes_in_a_hollow_and_on_a_hill(bend_per_mm: float) -> None:
    """As far as these are not steep: rows p apart leave slopes even in +-p / 2R, by the facets that they mill."""
    lens, pitch_mm, radius_mm = valley(bend_per_mm), 0.3, 3.0
    spec = replace(PAPER_PASSES[0], radius_mm=radius_mm)
    tracks = row_tracks(lens, radius_mm=radius_mm, pitch_mm=pitch_mm)
    near = (np.abs(tracks.tips_mm[:, :2] - SIDE_MM / 2) < 4).all(axis=1)
    tracks = replace(tracks, tips_mm=tracks.tips_mm[near], joined=tracks.joined[near])
    surface = MilledSurface.of_tracks([tracks], lens, pitch_mm=pitch_mm)
    facets = np.concatenate([surface.part(number) for number in range(surface.parts)])
    facets = facets[(np.abs(facets[:, :, :2].mean(axis=1) - SIDE_MM / 2) < 2).all(axis=1)]
    off = facets[:, :, 4] - lens.spline().jets(facets[:, :, 0], facets[:, :, 1])[2]
    most = float(np.sqrt((off**2).mean()))  # corners are where it is greatest
    assert most == pytest.approx(pitch_mm / (2 * radius_mm), rel=0.02)
    assert LensForm.of(lens).steepness(spec) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("bend_per_mm", [-0.02, 0.0, 0.02])
@pytest.mark.parametrize("reach_mm", [25.0, -25.0])
def test_grooves_spread_their_own_width_too(bend_per_mm: float, reach_mm: float) -> None:
    """Rows p apart touch a hollow of curvature k at p / (1 - kR); |1 + R / reach| of that by where light starts."""
    form, spec = LensForm.of(valley(bend_per_mm)), replace(PAPER_PASSES[0], radius_mm=3.0)
    wide, along = (form.widen_factor(replace(spec, direction=direction), reach_mm) for direction in ("x", "y"))
    assert along == pytest.approx(abs(1 + 3.0 / reach_mm), abs=0.002)
    assert wide == pytest.approx(along / (1 - 3.0 * bend_per_mm), rel=0.02)


@pytest.mark.parametrize("radius_mm", [0.5, 3.0, 6.0])
def test_tips_for_planning_are_those_of_the_tool_surface(radius_mm: float) -> None:
    """A hundredth of a millimetre, the bend between two places of its grid, is nothing to a layer."""
    lens = bumps(0.05)
    tips = LensForm.of(lens).tips_mm(radius_mm)
    count = min(160, ceil(16 * SIDE_MM / radius_mm))
    places = np.linspace(0.0, SIDE_MM, count + 1)
    outside = (len(tips) - places.size) // 2
    assert outside * SIDE_MM / count >= radius_mm
    exact = ToolSurface.over(lens, radius_mm=radius_mm).tip_rows_mm(places, places)
    assert tips[outside:-outside, outside:-outside] == pytest.approx(exact, abs=0.01)


def test_no_pass_asks_for_a_shank_that_the_spindle_cannot_take() -> None:
    form, tools = LensForm.of(bumps()), tuple(tool(radius) for radius in (1.5, 3.0, 4.0))
    held = replace(shop(*tools), collet_mm=6.35)
    found = make_plan(held, {one.radius_mm: form for one in tools}, Blur(), Goal(), fillings={})
    assert max(spec.radius_mm for one in found.front for spec in one.passes) == 3.0
    assert dict(found.left_out) == {tools[-1].name: "it has a shank of 8 mm; the mill's collet takes 6.35 mm"}


def test_hours_are_those_of_the_lens_that_will_be_milled() -> None:
    """A lens made sharper for its rows bends more: its chords are shorter, and on a slow link its rows slower."""
    lenses, slow = {3.0: LensForm.of(bumps(0.02))}, replace(MILL, lines_per_s=40.0)

    class Sharper(Blur):
        def settle(self, several: Iterable[Marks]) -> None:
            lenses[3.0] = LensForm.of(bumps(0.1))

    one = replace(shop(tool(3.0)), mill=slow)
    chosen = make_plan(one, lenses, Sharper(), Goal(), fillings={}).chosen
    assert chosen.seconds[-1] == pytest.approx(rows_s(lenses[3.0], chosen.finish, slow), rel=0.01)


def test_layers_are_as_shallow_as_frame_and_spindle_ask() -> None:
    light = replace(shop(tool(3.0)), removal_mm3_per_min=1000.0)
    finish = ball_pass("finish", radius_mm=3.0, pitch_mm=0.05, stock_to_leave_mm=0.0, step_down_mm=0.5)
    for one in (light, shop(tool(3.0))):
        before = Roughing(form=LensForm.of(bumps()), shop=one).plan_before(finish)
        assert before is not None
        rough = before.passes[0]
        removal = rough.pitch_mm * rough.step_down_mm * rough.feed_mm_per_min
        assert (0.97 * 1000 < removal <= 1000) is (one is light)
