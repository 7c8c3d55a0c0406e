"""A bob's program against Preston's law, integrated along its text by other means than the product's."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from cam.around.watch import CheckedMill
from cam.duration import Kinematics
from cam.moves import Array
from cam.parts import PassFrame, programs
from cam.passes import Stock
from cam.polish.check import PolishCheck, check_polish
from cam.polish.cut import PolishCut
from cam.polish.path import cover, polish_paths
from cam.posts.dialects import POSTS
from cam.surface.stock_grid import StockGrid
from optics.bob import Bob
from optics.bob_wear import Ground
from optics.heightfield import Heightfield
from service.job.stages.polish import plan_polish, wear_of
from tests.optics.bobs import make_finish, wear_down

SIDE_MM, DEPTH_MM, CELL_MM = 9.0, 0.08, 0.15
BOB = Bob(radius_mm=3.0, modulus_mpa=1.0, wear_per_mpa=8e-5, compression_mm=0.3, spindle_rpm=3000.0)
ACCELERATION, RATES = (400.0, 400.0, 200.0), (5000.0, 5000.0, 1000.0)


def height(x: Array, y: Array) -> Array:
    return np.asarray(-3.2 + 0.25 * x + 0.5 * np.sin(y / 3))


def slopes(x: Array, y: Array) -> tuple[Array, Array]:
    return np.full_like(x, 0.25), np.cos(y / 3) / 6


def bend(x: Array, y: Array) -> Array:
    """Mean curvature of the surface, above 0 on crests."""
    p, q = slopes(x, y)
    return np.asarray((1 + p**2) * np.sin(y / 3) / 18 / (2 * (1 + p**2 + q**2) ** 1.5))


def integrate(text: str, bob: Bob, at: Array) -> Array:
    """Return (n,) what comes off along Z at points (n, 2): by samples of every move a tenth of a millimetre apart, each
    with its contact found on the formula of the lens, and time from lengths and feeds alone.
    """
    place, feed, samples = np.array([np.nan] * 3), 0.0, []
    for line in text.splitlines():
        if line.startswith("(") or "G4" in line:
            continue
        words = dict(re.findall(r"([XYZF])(-?[\d.]+)", line))
        feed = float(words.get("F", feed))
        goal = np.array([float(words.get(axis, old)) for axis, old in zip("XYZ", place, strict=True)])
        if feed and np.isfinite(place).all() and (goal[:2] != place[:2]).any() and goal[2] < 0:
            length = float(np.linalg.norm(goal - place))
            count = max(1, round(length / 0.1))
            share = (np.arange(count) + 0.5)[:, None] / count
            samples.append(
                np.column_stack([place + share * (goal - place), np.full(count, 60 * length / feed / count)])
            )
        place = goal
    tip, dwell = np.vstack(samples)[:, :3], np.vstack(samples)[:, 3]
    centre = tip + np.array([0.0, 0.0, bob.radius_mm])
    px, py = centre[:, 0].copy(), centre[:, 1].copy()
    for _ in range(40):  # nearest point of the surface: p = c + (z - cz) grad z, damped
        p, q = slopes(px, py)
        lift = height(px, py) - centre[:, 2]
        px, py = 0.5 * (px + centre[:, 0] - lift * p), 0.5 * (py + centre[:, 1] - lift * q)
    contact = np.column_stack([px, py, height(px, py)])
    away = np.linalg.norm(centre - contact, axis=1)
    normal = (centre - contact) / away[:, None]
    deep, both = bob.radius_mm - away, 1 / bob.radius_mm + bend(px, py)
    radius2, peak = deep / both, 2 / np.pi * bob.modulus_mpa * np.sqrt(deep * both)
    turn = bob.spindle_rpm * 2 * np.pi / 60
    off = np.zeros(len(at))
    for k, point in enumerate(np.column_stack([at, height(at[:, 0], at[:, 1])])):
        near = np.hypot(px - point[0], py - point[1]) < 1.5
        from_contact = point - contact[near]
        aside = (from_contact**2).sum(axis=1) - (from_contact * normal[near]).sum(axis=1) ** 2
        pressure = peak[near] * np.sqrt(np.maximum(0.0, 1 - aside / radius2[near]))
        sliding = turn * np.hypot(*(point[:2] - centre[near, :2]).T)
        off[k] = (bob.wear_per_mpa * pressure * sliding * dwell[near] / normal[near, 2]).sum()
    return off


@pytest.mark.thorough
def test_the_written_program_takes_off_what_is_predicted() -> None:
    """Mean and unevenness of the removal, place by place, as planned and with more or less pressure or a worn bob."""
    x = np.linspace(0.0, SIDE_MM, 46)
    lens = Heightfield(x_mm=x, y_mm=x, z_mm=height(x[None, :], x[:, None]))
    stock = Stock(width_mm=SIDE_MM, height_mm=SIDE_MM, thickness_mm=20.0, margin_mm=10.0)
    task = PolishCut(
        radius_mm=BOB.radius_mm,
        compression_mm=BOB.compression_mm,
        contact_mm=BOB.contact_mm,
        plunge_mm_per_min=100.0,
        spindle_rpm=BOB.spindle_rpm,
        most_mm_per_s=6100.0,
        acceleration_mm_per_s2=ACCELERATION,
        max_rate_mm_per_min=RATES,
    )
    finish = make_finish(BOB, DEPTH_MM)
    ground = Ground.under(BOB, lens, beyond_mm=2.5 * BOB.contact_mm)
    lattice, dwell_s, rounds = plan_polish(ground, task, BOB, lens, stock, finish)
    paths = polish_paths(cover(task, lens), lattice, dwell_s, task, rounds=rounds, top_mm=0.0, safe_z_mm=5.0)
    frame = PassFrame(
        remarks=(), rpm=BOB.spindle_rpm, plunge_mm_per_min=100.0, safe_z_mm=5.0, aperture_mm=(SIDE_MM, SIDE_MM)
    )
    text = b"".join(piece for part in programs(paths, POSTS["grbl"], frame) for piece in part)
    kinematics = Kinematics(
        max_rate_mm_per_min=RATES,
        acceleration_mm_per_s2=ACCELERATION,
        junction_deviation_mm=0.02,
        planner_blocks=16,
        lines_per_s=1000.0,
    )
    block = StockGrid.block(stock, 0.1)
    cleared = replace(block, top_mm=np.full(block.top_mm.shape, -20.0))
    mill = CheckedMill(kinematics=kinematics, safe_z_mm=5.0, digit_mm=1e-5, xy_digit_mm=1e-4)

    def read(task: PolishCut) -> PolishCheck:
        return check_polish([[text]], task, lens=lens, stock=stock, stock_top=cleared, mill=mill)

    found = read(task)
    assert found.ok, found.faults
    assert found.verdict.time_s == pytest.approx(float(dwell_s.sum()), rel=0.05)
    side = np.arange(2.5, SIDE_MM - 2.5, 0.25)
    at = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    for other in (BOB, replace(BOB, modulus_mpa=0.8), replace(BOB, modulus_mpa=1.2), wear_down(BOB, 0.15)):
        told = ground.sample(wear_of(ground, other, read(replace(task, radius_mm=other.radius_mm))), at)
        real = integrate(text.decode(), other, at)
        assert told.mean() == pytest.approx(real.mean(), rel=0.02)
        assert np.abs(told - real).max() < 0.05 * real.mean()
        if other.radius_mm == BOB.radius_mm:
            planned_mm = DEPTH_MM * other.modulus_mpa
            assert real.mean() == pytest.approx(planned_mm, rel=0.05)
            assert real.std() < 0.05 * planned_mm
