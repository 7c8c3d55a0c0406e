"""Rest passes foretold: where, how long, with which ball; against the stock and the programs that come of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from cam.materials import PMMA
from cam.passes import Stock, ball_pass
from cam.planning.pass_time import LensForm
from cam.planning.planner import Goal, Marks, Plan
from cam.planning.rest import Filled, RestWork
from cam.planning.row_slopes import RowSlopes
from cam.planning.shop import Shop
from cam.surface.stock_grid import StockGrid
from cam.tools import Tool
from optics.closing import close_to_radius
from optics.heightfield import Heightfield
from tests.cam.balls import tool
from tests.cam.checks import MILL, checked
from tests.cam.programs import make_plan

SIDE = 14.0
STOCK = Stock(width_mm=SIDE, height_mm=SIDE, thickness_mm=20.0, margin_mm=8.0)


BIG, MIDDLE, SMALL = tool(3.0), tool(1.5), tool(0.5)


def shop(*tools: Tool) -> Shop:
    return Shop(
        tools=tools, material=PMMA, mill=MILL, spindle_rpm=(8000.0, 30_000.0), step_mm=0.001, noise_mm=0.0002,
        margin_mm=STOCK.margin_mm,
    )  # fmt: skip


def grooved(depth_mm: float, half_mm: float = 0.35) -> Heightfield:
    """A gentle hill with a groove along part of X: its bottom is hollow with a radius of half^2 / depth."""
    x, y = np.meshgrid(*(np.linspace(0.0, SIDE, 281),) * 2)
    z = -0.004 * ((x - 7) ** 2 + (y - 7) ** 2)
    z = z - depth_mm * np.exp(-(((y - 6) / half_mm) ** 2) / 2 - ((x - 7) / 1.5) ** 4)
    return Heightfield.on_aperture(z - z.max() - 0.1, width_mm=SIDE, height_mm=SIDE)


def fillings(lens: Heightfield, *tools: Tool) -> dict[float, Filled]:
    left = {
        one.radius_mm: close_to_radius(lens.z_mm, radius_mm=one.radius_mm, dx_mm=lens.dx_mm, dy_mm=lens.dy_mm)
        for one in tools
    }
    return {radius: Filled(lens=lens, over_mm=z - lens.z_mm) for radius, z in left.items()}


def work(lens: Heightfield, big: Tool, *others: Tool) -> RestWork:
    tools = (big, *others)
    return RestWork(big, form=LensForm.of(lens), shop=shop(*tools), fillings=fillings(lens, *tools))


FINISH = ball_pass("finish", radius_mm=3.0, pitch_mm=0.3, stock_to_leave_mm=0.0, step_down_mm=5.0)


@pytest.mark.thorough
@pytest.mark.parametrize("direction", ["x", "y"])
def test_a_rest_pass_is_as_large_and_as_long_as_the_one_that_is_cut(direction: str) -> None:
    """Area within 6 % of that of the stock which the big ball's program left, time within a tenth of its own
    program's: it has one entry and a few dozen short rows."""
    lens = grooved(0.12)
    foretold = work(lens, BIG, SMALL).plan_after(replace(FINISH, direction=direction))
    assert foretold is not None
    before = checked(lens, replace(FINISH, direction=direction), STOCK, StockGrid.block(STOCK, 0.03))
    found = checked(lens, foretold.spec, STOCK, before.stock_top)
    assert found.ok, found.faults
    assert foretold.extent.regions == found.rest.regions == 1
    assert foretold.extent.area_mm2 == pytest.approx(found.rest.area_mm2, rel=0.06)
    assert foretold.extent.seconds == pytest.approx(found.time_s, rel=0.1)
    assert foretold.extent.area_mm2 < 0.25 * SIDE**2


def test_where_the_ball_fits_there_is_nothing_to_plan() -> None:
    lens = grooved(0.005)
    assert work(lens, BIG, SMALL).plan_after(FINISH) is None
    assert RestWork(BIG, form=LensForm.of(lens), shop=shop(BIG, SMALL), fillings={}).plan_after(FINISH) is None


@pytest.mark.parametrize(("depth_mm", "taken"), [(0.05, "r1.5"), (0.12, "r0.5")])
def test_the_largest_ball_that_reaches_is_taken(depth_mm: float, taken: str) -> None:
    """The bottoms have radii of 2.4 and 1 mm."""
    found = work(grooved(depth_mm), BIG, MIDDLE, SMALL).plan_after(FINISH)
    assert found is not None
    assert found.tool.name == taken
    assert found.spec.where == "rest"
    assert found.spec.finishes


def test_a_ball_that_reaches_as_little_as_the_big_one_is_no_help() -> None:
    assert work(grooved(0.12), BIG, tool(2.9)).plan_after(FINISH) is None


def test_a_ball_whose_shank_would_touch_is_not_taken() -> None:
    stubby = replace(SMALL, shank_radius_mm=3.0, flute_length_mm=0.3)
    assert work(grooved(0.12), BIG, stubby).plan_after(FINISH) is None


def test_rows_are_as_close_for_their_ball_as_those_of_the_finish() -> None:
    """And never farther apart: scallops are as steep as the finish's, or less."""
    rests = work(grooved(0.12), BIG, SMALL)
    for pitch_mm in (0.07, 0.17, 0.34):
        spec = rests.plan_after(replace(FINISH, pitch_mm=pitch_mm)).spec
        ratio = (spec.pitch_mm / spec.radius_mm) / (pitch_mm / BIG.radius_mm)
        assert 0.6 < ratio <= 1.0 + 1e-9 or spec.pitch_mm == 0.01


class Valued:
    """Light that counts blur, and how much the valleys are worth when a small ball clears them."""

    def __init__(self, worth_db: float) -> None:
        self.worth_db = worth_db

    def psnr_db(self, marks: Marks) -> float:
        return -20 * np.log10(self.blur_mm(marks.slopes)) + self.worth_db * (marks.smallest_mm == SMALL.radius_mm)

    aimed_db = psnr_db

    def settle(self, several: Iterable[Marks]) -> None:
        """Its lenses are what they are."""

    def blur_mm(self, slopes: RowSlopes) -> float:
        return 49.0 * slopes.across.rms


def planned(worth_db: float, left: Mapping[float, Filled], lens: Heightfield) -> Plan:
    form = LensForm.of(lens)
    tools = (BIG, SMALL)
    return make_plan(shop(*tools), {one.radius_mm: form for one in tools}, Valued(worth_db), Goal(), fillings=left)


@pytest.mark.parametrize(("worth_db", "rests"), [(6.0, True), (0.0, False)])
def test_valleys_are_cleared_where_they_are_worth_the_time(worth_db: float, rests: bool) -> None:
    lens = grooved(0.06)
    found = planned(worth_db, fillings(lens, BIG, SMALL), lens)
    chosen = found.chosen
    assert (chosen.rest is not None) == rests
    assert chosen.tool.name == "r3"
    assert [spec.where for spec in chosen.passes] == ["everywhere"] * (len(chosen.passes) - rests) + ["rest"] * rests
    assert len(chosen.passes) == len(chosen.seconds)
    assert chosen.finish.radius_mm == 3.0
    assert (*chosen.before, chosen.finish) == chosen.passes[: len(chosen.passes) - rests]
    for one in found.front:
        assert (one.rest is None) or one.tool.name == "r3"
