"""A bob's path has no preferred direction and keeps within what the axes can do; its check catches planted faults."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cam.around.watch import CheckedMill
from cam.duration import Kinematics
from cam.errors import PassValueError
from cam.moves import Array, Motion
from cam.parts import PassFrame, programs
from cam.passes import Stock
from cam.polish.check import PolishCheck, check_polish
from cam.polish.cut import PolishCut
from cam.polish.path import Lattice, count_rounds, cover, lay_lattice, polish_paths
from cam.posts.dialects import POSTS
from cam.posts.remarks import describe_around
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield

SIDE_MM, DWELL_S = 10.0, 0.5
STOCK = Stock(width_mm=SIDE_MM, height_mm=SIDE_MM, thickness_mm=20.0, margin_mm=10.0)
TASK = PolishCut(
    radius_mm=3.0,
    compression_mm=0.3,
    contact_mm=0.95,
    plunge_mm_per_min=100.0,
    spindle_rpm=10_000.0,
    most_mm_per_s=6100.0,
    acceleration_mm_per_s2=(400.0, 400.0, 200.0),
    max_rate_mm_per_min=(5000.0, 5000.0, 1000.0),
)
KINEMATICS = Kinematics(
    max_rate_mm_per_min=TASK.max_rate_mm_per_min,
    acceleration_mm_per_s2=TASK.acceleration_mm_per_s2,
    junction_deviation_mm=0.02,
    planner_blocks=16,
    lines_per_s=1000.0,
)


@cache
def make_lens() -> Heightfield:
    x = np.linspace(0.0, SIDE_MM, 41)
    z = -1.5 + 0.3 * np.sin(x / 3)[:, None] + 0.1 * x
    return Heightfield(x_mm=x, y_mm=x, z_mm=z - z.max() - 0.1)


def make_stock(floor_mm: float = -10.0) -> StockGrid:
    """Return a pit six millimetres wider than the lens on each side, its floor far below."""
    block = StockGrid.block(STOCK, 0.1)
    pit = (np.abs(block.x_mm - SIDE_MM / 2) < SIDE_MM / 2 + 6) & (np.abs(block.y_mm - SIDE_MM / 2) < SIDE_MM / 2 + 6)[
        :, None
    ]
    return replace(block, top_mm=np.where(pit, floor_mm, 0.0))


@cache
def lay() -> Lattice:
    return lay_lattice(cover(TASK, make_lens()), STOCK, TASK)


@cache
def write(rounds: int = 1) -> str:
    lattice = lay()
    dwell = rounds * DWELL_S * np.ones(lattice.near.shape)
    paths = polish_paths(cover(TASK, make_lens()), lattice, dwell, TASK, rounds=rounds, top_mm=0.0, safe_z_mm=5.0)
    frame = PassFrame(
        remarks=describe_around(TASK, STOCK),
        rpm=TASK.spindle_rpm,
        plunge_mm_per_min=TASK.plunge_mm_per_min,
        safe_z_mm=5.0,
        aperture_mm=(SIDE_MM, SIDE_MM),
    )
    return b"".join(piece for part in programs(paths, POSTS["grbl"], frame) for piece in part).decode()


def check(text: str, task: PolishCut = TASK, top: StockGrid | None = None) -> PolishCheck:
    mill = CheckedMill(kinematics=KINEMATICS, safe_z_mm=5.0, digit_mm=1e-5, xy_digit_mm=1e-4)
    return check_polish(
        [[text.encode()]], task, lens=make_lens(), stock=STOCK, stock_top=top or make_stock(), mill=mill
    )


def all_points(rounds: int) -> Array:
    lattice = lay()
    paths = list(
        polish_paths(
            cover(TASK, make_lens()), lattice, np.full(lattice.near.shape, DWELL_S), TASK,
            rounds=rounds, top_mm=0.0, safe_z_mm=5.0,
        )
    )  # fmt: skip
    assert [path.motion for path in paths].count(Motion.RAPID) == 2  # down and up: one connected path
    return np.vstack([path.points_mm for path in paths[1:-1]])


def test_the_path_has_no_preferred_direction() -> None:
    """Every direction has the same share of the length within a tenth, and no corner is sharper than a chord's."""
    way = np.diff(all_points(1)[:, :2], axis=0)
    length, turn = np.hypot(*way.T), np.arctan2(way[:, 1], way[:, 0])
    share, _ = np.histogram(turn, bins=8, range=(-np.pi, np.pi), weights=length)
    assert share.max() / share.min() < 1.1
    corner = np.abs((np.diff(turn) + np.pi) % (2 * np.pi) - np.pi)
    assert np.quantile(corner, 0.995) < 2.1 * np.pi / 16 + 0.05


def test_the_path_covers_the_lens_and_stays_near() -> None:
    points, reach = all_points(2), TASK.most_reach_mm + TASK.loop_mm
    assert points[:, :2].min() > -reach and points[:, :2].max() < SIDE_MM + reach
    cells, _, _ = np.histogram2d(*points[:, :2].T, bins=int(SIDE_MM / 0.5), range=[[0, SIDE_MM]] * 2)
    assert cells.min() > 0.6 * cells.mean()


def test_a_round_spends_the_planned_dwell() -> None:
    """The time over the inner lens is the lattice's dwell, and the whole takes what the feeds say: axes follow."""
    found = check(write())
    assert found.ok, found.faults
    inner = ((found.tip_mm[:, :2] > 2) & (found.tip_mm[:, :2] < SIDE_MM - 2)).all(axis=1)
    planned = DWELL_S * (SIDE_MM - 4) ** 2 / TASK.node_mm**2
    assert found.dwell_s[inner].sum() == pytest.approx(planned, rel=0.03)
    assert found.compression_mm == pytest.approx((0.3, 0.3), rel=0.1)
    assert found.verdict.entries == 1


def test_rounds_follow_from_the_greatest_feed() -> None:
    least = TASK.least_dwell_s
    assert count_rounds(np.full(100, 3.5 * least), TASK) == 3
    with pytest.raises(PassValueError, match="at most 5000 rpm"):
        count_rounds(np.full(100, 0.5 * least), TASK)


def shift_z(text: str, by_mm: float) -> str:
    """Return the program with every Z below the block's top moved."""

    def move(found: re.Match[str]) -> str:
        z = float(found[1])
        return f"Z{z + by_mm:.5f}" if z < 0 else found[0]

    return re.sub(r"Z(-?[\d.]+)", move, text)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda text: shift_z(text, -0.1), "presses the bob 0.40"),
        (lambda text: shift_z(text, 0.1), "presses the bob 0.20"),
        (lambda text: re.sub(r"M3S\d+\n", "", text), "with the spindle off"),
        (lambda text: text.replace("\nX", "\nG0X", 1).replace("\nX", "\nG1X", 1), "is a rapid"),
    ],
    ids=["deep", "shallow", "still", "rapid"],
)
def test_planted_faults_are_found(spoil: Callable[[str], str], words: str) -> None:
    found = check(spoil(write()))
    assert any(words in str(fault) for fault in found.faults), found.faults


def test_a_wall_too_near_is_found() -> None:
    """The path reaches 4 mm out where the lens is steep; a wall 3 mm beyond the rim is within the bob."""
    block = make_stock()
    near = (np.abs(block.x_mm - SIDE_MM / 2) < SIDE_MM / 2 + 3) & (np.abs(block.y_mm - SIDE_MM / 2) < SIDE_MM / 2 + 3)[
        :, None
    ]
    found = check(write(), top=replace(block, top_mm=np.where(near, block.top_mm, 0.0)))
    assert any("into the wall" in str(fault) for fault in found.faults)


def test_rubbing_too_fast_is_found() -> None:
    found = check(write(), replace(TASK, most_mm_per_s=900.0))
    assert any("rubs at" in str(fault) and "allowed: 0.9 m/s" in str(fault) for fault in found.faults)


def test_a_program_that_does_nothing_is_refused() -> None:
    found = check(write().replace("\nX", "\nG0X", 1))  # modal: every move is a rapid
    assert any("never moves along the lens" in str(fault) for fault in found.faults)
