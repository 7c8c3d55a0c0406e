"""Whether a tool of a finish gets to the rims: against a round tool that is put there, and what plans make of it."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cam.passes import PassSpec, ball_pass
from cam.planning.shop import CLEAR_MM
from optics.finish import Finish
from optics.heightfield import Array, Heightfield
from service.job.planning.rim_room import (
    LEAST_TOOL_MM,
    RimRoom,
    advise_on_rims,
    measure_rim_room,
    warn_of_rim_room,
    weigh_removal,
)
from service.job.report.finishing import make_finishing_card

WIDE_MM = 100.0  # a margin that no cut leaves
FELT = Finish(k0_rad_per_mm=1.4588, order=1.0, pad_mm=10.0, depth_mm=0.0276)  # 85 minutes on 100 cm2


def lens_at(depth_mm: float, tilt: float = 0.0) -> Heightfield:
    z = -depth_mm - tilt * np.linspace(0.0, 20.0, 9)
    return Heightfield.on_aperture(np.tile(z, (9, 1)), width_mm=20.0, height_mm=20.0)


def ball(radius_mm: float, *, leave_mm: float = 0.0) -> PassSpec:
    return ball_pass(
        "a", radius_mm=radius_mm, pitch_mm=radius_mm / 8, stock_to_leave_mm=leave_mm, step_down_mm=radius_mm / 3
    )


def room_of(depth_mm: float, *passes: PassSpec, finish: Finish = FELT, margin_mm: float = WIDE_MM) -> RimRoom:
    room = measure_rim_room(lens_at(depth_mm), passes, finish, margin_mm=margin_mm)
    assert room is not None
    return room


def flank(radius_mm: float, depth_mm: float) -> Array:
    """Return (n, 2) of the pit's side: how far beyond the rim, and how high over its floor, up to the block's top."""
    turn = np.linspace(0.0, math.pi / 2, 400)
    x, z = radius_mm * (1.0 + np.sin(turn)), radius_mm * (1.0 - np.cos(turn))
    up = np.linspace(radius_mm, max(radius_mm, depth_mm), 400)
    all_of_it = np.concatenate([np.column_stack([x, z]), np.column_stack([np.full_like(up, 2 * radius_mm), up])])
    top = np.array([[radius_mm + math.sqrt(max(0.0, 2 * radius_mm * depth_mm - depth_mm**2)), depth_mm]])
    below = all_of_it[all_of_it[:, 1] <= depth_mm]
    return np.concatenate([below, top]) if depth_mm < radius_mm else below


@given(
    radius_mm=st.floats(0.5, 8.0),
    depth_mm=st.floats(0.01, 40.0),
    k0=st.floats(0.7, 20.0),
    larger=st.floats(1.03, 3.0),
)
def test_a_round_tool_of_that_size_stands_beyond_the_rim_and_a_larger_one_does_not(
    radius_mm: float, depth_mm: float, k0: float, larger: float
) -> None:
    finish = replace(FELT, k0_rad_per_mm=k0)
    assume(finish.reach_mm <= radius_mm)
    room = room_of(depth_mm, ball(radius_mm), finish=finish)
    side = flank(radius_mm, depth_mm)

    def stands(tool_mm: float) -> bool:
        middle = np.array([finish.reach_mm, tool_mm / 2])
        return bool(np.hypot(*(side - middle).T).min() >= tool_mm / 2 - 1e-6)

    assert stands(room.largest_mm)
    assert not stands(larger * room.largest_mm)


@given(radius_mm=st.floats(0.5, 8.0), depth_mm=st.floats(0.01, 40.0), deeper_mm=st.floats(0.0, 40.0))
def test_a_deeper_rim_leaves_no_more_room_and_below_the_ball_the_same(
    radius_mm: float, depth_mm: float, deeper_mm: float
) -> None:
    """So neither a wall farther away nor a tilted lens makes room."""
    finish = replace(FELT, k0_rad_per_mm=4.3 / radius_mm)
    one, other = (room_of(depth, ball(radius_mm), finish=finish) for depth in (depth_mm, depth_mm + deeper_mm))
    assert other.largest_mm <= one.largest_mm * (1 + 1e-9)
    if depth_mm >= 2 * radius_mm:
        assert other.largest_mm == pytest.approx(one.largest_mm)


def test_the_pit_of_a_ball_of_3_mm_wants_a_smaller_tool_than_the_usual_felt() -> None:
    """A rim 8 to 26 mm deep, the wall 6 mm beside it, 2.9 mm to go beyond: no bob of 10 mm, but one of 6."""
    room = measure_rim_room(lens_at(8.0, tilt=0.9), [ball(3.0, leave_mm=0.2), ball(3.0)], FELT, margin_mm=20.0)
    assert room is not None
    assert room.depth_mm == pytest.approx((8.0, 26.0))
    assert room.wall_mm == pytest.approx(6.0)
    assert room.tool_mm == pytest.approx(6.2, abs=0.1)
    assert room.band_mm == pytest.approx(4.0)
    assert warn_of_rim_room(room) is None
    advice = advise_on_rims(room)
    assert advice is not None
    for words in ("8.0 to 26.0 mm", "6.0 mm away", "6.2 mm instead of 10 mm", "38 % of the force", "2.6 times"):
        assert words in advice


@given(
    finishing_mm=st.floats(0.25, 8.0), rough_mm=st.floats(0.25, 8.0), k0=st.floats(0.7, 20.0), depth=st.floats(0.05, 40)
)
def test_there_is_advice_a_warning_or_nothing_to_say(
    finishing_mm: float, rough_mm: float, k0: float, depth: float
) -> None:
    finish = replace(FELT, k0_rad_per_mm=k0)
    room = room_of(depth, ball(rough_mm, leave_mm=0.2), ball(finishing_mm), finish=finish)
    advice, warning = advise_on_rims(room), warn_of_rim_room(room)
    assert (warning is not None) == (room.largest_mm < LEAST_TOOL_MM)
    assert (advice is not None) == (LEAST_TOOL_MM <= room.largest_mm <= 0.9 * FELT.pad_mm)
    if finish.reach_mm > finishing_mm + 0.2:
        assert warning is not None  # beyond the floor that is as smooth as the lens
    if warning is not None:
        assert f"{finish.reach_mm:.1f} mm beyond" in warning
        told = re.search(r"a ball of R ([\d.]+) .* stock.margin_mm = (\d+)", warning)
        assert told is not None
        radius_mm, margin_mm = map(float, told.groups())
        assert room_of(40.0, ball(radius_mm), finish=finish, margin_mm=margin_mm).is_reached
        assert margin_mm >= 2 * radius_mm + CLEAR_MM  # or the planner leaves the ball out


@pytest.mark.parametrize("turns", range(4))
def test_all_four_rims_count(turns: int) -> None:
    """One that lies deep in the pit and leaves less room than the others."""
    one = lens_at(0.5)
    z = np.array(one.z_mm)
    z[1:-1, -1] = -9.0
    turned = replace(one, z_mm=np.rot90(z, turns))
    room = measure_rim_room(turned, [ball(3.0)], FELT, margin_mm=WIDE_MM)
    assert room is not None and room.depth_mm == (0.5, 9.0)
    assert room.wall_mm == 6.0  # not that of the shallow rims, which is nearer, and lower
    assert room.largest_mm == room_of(9.0, ball(3.0)).largest_mm < room_of(0.5, ball(3.0)).largest_mm


def test_the_wall_is_that_of_the_pass_that_cuts_farthest_and_of_none_that_cuts_in_places() -> None:
    """A rough pass leaves its floor higher by what it is to leave, and so meets the block's top nearer."""
    finish, rough, flat = ball(1.0), ball(3.0, leave_mm=0.2), replace(ball(3.0, leave_mm=0.2), corner_radius_mm=0.0)
    rest = replace(ball(6.0), where="rest")
    walls = [room_of(1.0, *passes).wall_mm for passes in ((finish,), (rough, finish), (flat, finish), (finish, rest))]
    assert walls == pytest.approx([2.0, 3.0 + math.sqrt(2 * 3.0 * 0.8 - 0.8**2), 6.0, 2.0])


def test_films_need_no_room_and_a_block_without_a_wall_leaves_any() -> None:
    film = replace(FELT, depth_mm=None)
    assert measure_rim_room(lens_at(5.0), [ball(0.5)], film, margin_mm=WIDE_MM) is None
    assert warn_of_rim_room(None) is None and advise_on_rims(None) is None
    unwalled = room_of(5.0, ball(3.0), margin_mm=3.0)
    assert math.isinf(unwalled.largest_mm) and math.isinf(unwalled.wall_mm) and unwalled.is_reached
    assert advise_on_rims(unwalled) is None and warn_of_rim_room(unwalled) is None
    assert measure_rim_room(lens_at(5.0), [ball(3.0, leave_mm=0.1)], FELT, margin_mm=WIDE_MM) is None


def test_what_comes_off_is_weighed_with_the_run_out() -> None:
    """27.6 um off a lens of 100 mm, and 2.9 mm around it, of acrylic."""
    lens = Heightfield.on_aperture(np.zeros((5, 5)) - 1.0, width_mm=100.0, height_mm=100.0)
    assert weigh_removal(lens, FELT, 1.19) == pytest.approx(0.0276 * 105.8**2 * 1.19e-3, rel=1e-3)


def test_the_sheet_says_which_tool_and_what_a_scale_shows() -> None:
    room = room_of(8.0, ball(3.0))
    report = {"finishing": {"process": "felt"}, "rim_room": {"advice": advise_on_rims(room), "removed_g": 0.3677}}
    card = make_finishing_card(report)
    assert card is not None
    assert card["rims"] == [advise_on_rims(room)]
    assert any("0.37 g come off" in figure for _, figure in card["rows"])
    bare = make_finishing_card({"finishing": {"process": "lacquer"}})
    assert bare is not None and bare["rims"] == [] and not any("come off" in figure for _, figure in bare["rows"])
