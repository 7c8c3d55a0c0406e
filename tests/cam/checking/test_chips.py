"""Chips of written programs: shares of the time, by feed and speed as they are read back."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cam.checking.chips import Chips
from cam.checking.flat_removal import removal_of
from cam.duration import DurationModel, Kinematics
from cam.passes import Stock, ball_pass
from cam.reading.gcode import BATCH_BYTES
from cam.surface.stock_grid import StockGrid
from tests.cam.programs import read_program

STOCK = Stock(width_mm=40, height_mm=10, thickness_mm=10, margin_mm=2)
MILL = Kinematics(
    max_rate_mm_per_min=(6000, 6000, 6000), acceleration_mm_per_s2=(1e6, 1e6, 1e6), junction_deviation_mm=0.01,
    planner_blocks=16, lines_per_s=1e6,
)  # fmt: skip
SPEC = replace(
    ball_pass("cut", radius_mm=1.0, pitch_mm=0.2, stock_to_leave_mm=0.0, step_down_mm=1.0), chip_mm=(0.02, 0.1)
)
HEAD = "G21G90G94G17G54\nM3S{rpm}\nG0X0Y2Z5\nG0Z1\nG1Z-0.5F600\n"


def measure(text: str, mill: Kinematics = MILL, flutes: int = 2):
    duration, chips = DurationModel(mill), Chips(replace(SPEC, flutes=flutes))
    grid = removal_of(SPEC.shape, StockGrid.block(STOCK, 0.05), radius_mm=SPEC.radius_mm)
    for batch in read_program([text.encode()]):
        chips.add(batch, grid.cut(batch), duration.add_batch(batch))
    return chips.finish(duration.list_waiting_s())


def test_time_below_within_and_above_by_what_is_read_back():
    """40 mm at F100, F1000 and F5000 with 10 000 rpm and two edges: 5, 50 and 250 um, for 24, 2.4 and 0.48 s."""
    rows = "G1X40F100\nY3F600\nX0F1000\nY4F600\nX40F5000\nM5\nM2\n"
    found = measure(HEAD.format(rpm=10_000) + rows)
    assert found.seconds == pytest.approx((24.0, 2.4 + 0.35, 0.48), abs=0.1)
    assert found.thinnest_mm == pytest.approx(0.005, rel=0.01) and found.line == 6
    assert measure(HEAD.format(rpm=2_000) + rows).share > 0.8  # a fifth of the speed: 25 um, within the band
    assert measure(HEAD.format(rpm=10_000) + rows, flutes=1).thinnest_mm == pytest.approx(0.01, rel=0.01)


def test_air_and_rapids_are_no_cutting_time():
    found = measure(HEAD.format(rpm=10_000) + "G1X40F1000\nX0F10\nM5\nM2\n")  # back in its own slot: air
    assert found.share == 1.0 and sum(found.seconds) == pytest.approx(2.4, abs=0.2)


def test_a_link_that_starves_the_mill_thins_its_chips():
    """100 lines a second of 0.01 mm carry F60 of F1000: 3 um of 50."""
    rows = "".join(f"X{k / 100:.2f}F1000\n" for k in range(1, 4001))
    found = measure(HEAD.format(rpm=10_000) + "G1\n" + rows + "M5\nM2\n", replace(MILL, lines_per_s=100.0))
    assert found.share < 0.1 and found.line > 3900
    assert (found.thinnest_mm, found.written_mm) == pytest.approx((0.003, 0.05), rel=0.02)


def test_a_mill_that_speeds_up_and_brakes_thins_its_chips():
    """From rest and to rest over 10 mm at 50 mm/s2, a chip of 20 um (F400) is there from 0.44 mm to 0.44 mm before the
    end: 2 v / a of 2 sqrt(d / a) seconds are below.
    """
    weak = replace(MILL, acceleration_mm_per_s2=(50.0, 50.0, 1e6), planner_blocks=2000)
    rows = "".join(f"X{k / 10:.1f}\n" for k in range(1, 101))  # longer than cells
    found = measure(HEAD.format(rpm=10_000) + "G4P0.1\nG1F6000\n" + rows + "G4P0.1\nM5\nM2\n", weak)
    below_s, whole_s, plunge_s = 2 * (400 / 60) / 50, 2 * (10 / 50) ** 0.5, 1.5 / 10
    assert found.seconds == pytest.approx((below_s, whole_s - below_s + plunge_s, 0.0), abs=0.02)


def test_batches_do_not_change_the_sums():
    rows = "".join(f"X{k / 1000:.3f}F{100 + k % 7 * 400}\n" for k in range(1, 40_001))
    text = HEAD.format(rpm=10_000) + "G1\n" + rows + "M5\nM2\n"
    padded = text.replace("\n", " " * 60 + "\n")
    assert len(padded) > BATCH_BYTES / 2
    one, other = measure(text), measure(padded + "")
    assert one.seconds == pytest.approx(other.seconds)
