"""Witness marks are what their rows say, beside the lens and nowhere else; the check sees where it is not so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cam.around.check import AroundCheck, check_witness
from cam.around.paths import aperture_corners, make_witness_paths
from cam.around.specs import WitnessCut
from cam.errors import PassValueError, SafeHeightError
from cam.moves import Path
from cam.passes import Clamp, Stock
from tests.cam.around.test_around import DIALECTS, SAFE_Z, mill_of, raw, written

STOCK = Stock(width_mm=12, height_mm=8, thickness_mm=6, margin_mm=5)
TIPS = tuple(-0.1 - 0.004 * (k % 3) for k in range(40))
FRONT = WitnessCut(
    radius_mm=1.0, along="x", places_mm=tuple(1.0 + 0.2 * k for k in range(40)), tips_mm=TIPS, across_mm=(-4.5, -1.5),
    step_down_mm=0.5, feed_mm_per_min=600, plunge_mm_per_min=200, spindle_rpm=12000,
)  # fmt: skip
LEFT = replace(FRONT, along="y", places_mm=tuple(0.1 + 0.2 * k for k in range(40)))
BACK = replace(FRONT, across_mm=(12.5, 9.5))


def checked(
    task: WitnessCut, paths: list[Path] | None = None, *, dialect: str = "grbl", stock: Stock = STOCK
) -> AroundCheck:
    paths = list(make_witness_paths(task, top_mm=0.0, safe_z_mm=SAFE_Z)) if paths is None else paths
    return check_witness(
        written(paths, dialect=dialect),
        task,
        stock=stock,
        stock_top=raw(0.0, 0.05),
        mill=mill_of(dialect),
        corners_mm=aperture_corners(stock),
    )


@pytest.mark.parametrize("task", [FRONT, LEFT, BACK], ids=["front", "left", "back"])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_they_are_cut_as_they_should_be_on_every_side_and_by_every_dialect(task: WitnessCut, dialect: str) -> None:
    found = checked(task, dialect=dialect)
    assert found.faults == ()
    assert found.entries == 1 and found.gouge_um == 0.0
    assert found.clear_um == pytest.approx(500.0, abs=2.0)  # 1.5 mm from the lens, less the ball
    assert 0.099 < found.max_engagement_mm < 0.12


def test_their_heights_are_those_of_a_ball_in_its_rows() -> None:
    """Worked out here from one row's circle, not by the check: over a row its tip, between rows the cusp."""
    flat = replace(FRONT, tips_mm=(-0.1,) * 40)
    after = checked(flat).stock_top
    row = after.top_mm[int(np.abs(after.y_mm + 3.0).argmin())]
    inside = (after.x_mm > 1.0) & (after.x_mm < 8.8)
    assert row[inside].min() == pytest.approx(-0.1, abs=0.025**2 / 2 + 1e-5)  # half a cell from the row
    assert row[inside].max() == pytest.approx(-0.1 + 1 - np.sqrt(1 - 0.1**2), abs=0.003)


def lowered(paths: list[Path], *, by_mm: float, row: int) -> list[Path]:
    """The same paths, one row at another height."""
    way = paths[3].points_mm.copy()
    way[2 * row - 1 : 2 * row + 1, 2] -= by_mm
    return [*paths[:3], replace(paths[3], points_mm=way), *paths[4:]]


@pytest.mark.parametrize("by_mm", [0.0005, -0.0005])
def test_a_row_at_another_height_is_a_fault(by_mm: float) -> None:
    paths = list(make_witness_paths(FRONT, top_mm=0.0, safe_z_mm=SAFE_Z))
    found = checked(FRONT, lowered(paths, by_mm=by_mm, row=12))  # one in the middle of its period
    assert any("off their heights" in fault for fault in found.faults)


def moved(paths: list[Path], *, by_mm: tuple[float, float, float]) -> list[Path]:
    return [replace(path, points_mm=path.points_mm + np.array(by_mm)) for path in paths]


@pytest.mark.parametrize(
    ("by_mm", "words"),
    [
        ((0.0, 0.0, -0.05), "goes to Z"),
        ((0.0, 1.0, 0.0), "into the lens"),
        ((0.3, 0.0, 0.0), "beside the strip"),
        ((0.0, -1.0, 0.0), "beyond the block"),
        ((0.0, 0.0, -2.0), "a rapid"),
    ],
)
def test_a_program_that_cuts_elsewhere_is_a_fault(by_mm: tuple[float, float, float], words: str) -> None:
    paths = list(make_witness_paths(FRONT, top_mm=0.0, safe_z_mm=SAFE_Z))
    assert any(words in fault for fault in checked(FRONT, moved(paths, by_mm=by_mm)).faults)


def test_a_clamp_on_the_strip_is_a_fault() -> None:
    clamp = Clamp(x_mm=3.0, y_mm=-5.0, width_mm=2.0, depth_mm=2.0, height_mm=3.0)
    found = checked(FRONT, stock=replace(STOCK, clamps=(clamp,)))
    assert any("clamp" in fault for fault in found.faults)


def test_the_stock_s_top_is_entered_from_above_it() -> None:
    paths = list(make_witness_paths(FRONT, top_mm=0.3, safe_z_mm=SAFE_Z))
    assert paths[0].points_mm[-1, 2] == pytest.approx(1.3) and paths[1].points_mm[-1, 2] == pytest.approx(0.4)
    with pytest.raises(SafeHeightError):
        list(make_witness_paths(FRONT, top_mm=4.5, safe_z_mm=SAFE_Z))


@pytest.mark.parametrize("tips", [(0.0,) * 40, (-1.5,) * 40])
def test_rows_above_the_block_or_deeper_than_the_ball_are_refused(tips: tuple[float, ...]) -> None:
    with pytest.raises(PassValueError):
        replace(FRONT, tips_mm=tips)
