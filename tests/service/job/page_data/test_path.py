"""pass-N.path holds the path of the program: exactly in its full level, within what they say in the others."""

from __future__ import annotations

import tempfile
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.duration import DurationModel
from service.job.page_data import path as path_module
from service.job.page_data.path import MOST_POINTS
from service.job.page_data.points import Chords, Points, Thinner
from tests.service.job.page_data.paths import MILL, along, batch_of, cut_in, farthest_mm, header, level, rows, written

QUANTUM_MM = 1e-3  # a chunk's box over 65535, at 20 mm and with the rounding of its corners
SEEDS = st.integers(0, 10_000)


def wandering(seed: int, count: int = 400) -> np.ndarray:
    """A path as no program has one: long and short moves in all directions, some going nowhere."""
    rng = np.random.default_rng(seed)
    lengths = 10.0 ** rng.uniform(-3, 0.7, count) * (rng.random(count) > 0.05)
    return np.cumsum(rng.standard_normal((count, 3)) * lengths[:, None], axis=0)


def small_files(most: int = 100) -> object:
    """Levels even for short paths."""
    return patch.object(path_module, "MOST_POINTS", most)


@given(SEEDS, st.integers(1, 7))
def test_the_full_level_is_every_move_with_its_time(seed: int, pieces: int) -> None:
    rng = np.random.default_rng(seed)
    batch = batch_of(wandering(seed), rapid=rng.random(399) < 0.2)
    with tempfile.TemporaryDirectory() as folder:
        data = written(Path(folder), cut_in(batch, pieces))
    full = level(data, -1)
    moved = np.flatnonzero((np.diff(batch.points_mm, axis=0) != 0).any(axis=1))
    wanted = np.concatenate([batch.points_mm[:1], batch.points_mm[moved + 1]])
    quantum = np.ptp(wanted, axis=0).max() / 65535
    assert np.abs(full.mm - wanted).max() <= quantum
    assert (full.rapid[1:] == batch.is_rapid[moved]).all()
    assert not full.hidden[1:].any()
    model = DurationModel(MILL)
    model.add(batch)
    assert header(data)["time_s"] == model.seconds
    assert full.time_s[-1] == pytest.approx(model.seconds, rel=1e-6)


@given(SEEDS)
def test_time_is_that_of_the_mill_move_by_move(seed: int) -> None:
    """The end of each move is when a program ending there with the same look-ahead would not be earlier."""
    batch = batch_of(wandering(seed, 60))
    with tempfile.TemporaryDirectory() as folder:
        full = level(written(Path(folder), [batch]), -1)
    assert (np.diff(full.time_s) >= 0).all()
    lengths = np.linalg.norm(np.diff(full.mm, axis=0), axis=1)
    assert (np.diff(full.time_s) >= lengths / 10.0 - full.time_s[-1] / 16383 - 1e-3).all()  # 600 mm/min at the most


@pytest.mark.thorough
@given(SEEDS)
def test_no_level_strays_from_the_path_nor_leaves_anything_out(seed: int) -> None:
    batch = batch_of(wandering(seed, 300))
    with tempfile.TemporaryDirectory() as folder, small_files():
        data = written(Path(folder), cut_in(batch, 3))
    levels = header(data)["levels"]
    assert len(levels) > 1
    for number in range(len(levels) - 1):
        drawn = level(data, number)
        starts, ends = drawn.segments()
        assert farthest_mm(drawn.mm, batch.start_mm, batch.end_mm) <= drawn.tolerance_mm + QUANTUM_MM
        assert farthest_mm(along(starts, ends, 0.5), batch.start_mm, batch.end_mm) <= drawn.tolerance_mm + QUANTUM_MM
        assert farthest_mm(along(batch.start_mm, batch.end_mm, 0.5), starts, ends) <= drawn.tolerance_mm + QUANTUM_MM


def test_the_errors_of_the_levels_before_are_part_of_a_tolerance(tmp_path: Path) -> None:
    """A path that jitters on every scale, so that chords of all levels use all that they may."""
    side = np.random.default_rng(2).standard_normal(3000).cumsum() * 0.02
    batch = batch_of(np.stack([np.linspace(0.0, 20.0, side.size), side, np.zeros_like(side)], axis=1))
    with small_files():
        data = written(tmp_path, [batch], side_mm=200.0)
    coarser = [level(data, number) for number in range(len(header(data)["levels"]) - 1)]
    assert len(coarser) > 2
    for drawn in coarser:
        assert farthest_mm(batch.points_mm, *drawn.segments()) <= drawn.tolerance_mm + QUANTUM_MM


def test_rows_closer_than_can_be_seen_are_left_out_evenly_and_nothing_else(tmp_path: Path) -> None:
    """600 rows over 12 mm; the glance shows every place within its tolerance, by far fewer points."""
    batch = batch_of(rows(600))
    with small_files(6000):
        data = written(tmp_path, cut_in(batch, 4))
    glance = level(data, 0)
    starts, ends = glance.segments()
    rng = np.random.default_rng(1)
    somewhere = batch.points_mm[rng.integers(0, len(batch.points_mm), 3000)]
    assert farthest_mm(somewhere, starts, ends) <= glance.tolerance_mm + QUANTUM_MM
    assert len(glance.mm) < 0.05 * len(batch)
    seen = np.unique(np.round(starts[:, 1], 3))
    assert np.diff(seen).max() <= 2 * glance.tolerance_mm


@given(SEEDS)
def test_order_and_time_are_kept(seed: int) -> None:
    batch = batch_of(wandering(seed, 300))
    with tempfile.TemporaryDirectory() as folder, small_files():
        data = written(Path(folder), [batch])
    full = level(data, -1)
    for number in range(len(header(data)["levels"])):
        drawn = level(data, number)
        assert (np.diff(drawn.time_s) >= 0).all()
        assert drawn.time_s[[0, -1]] == pytest.approx(full.time_s[[0, -1]], abs=1e-3)
        tick = full.time_s[-1] / 16383 + 1e-4
        nearest = [np.linalg.norm(full.mm - p, axis=1) + 1e3 * (np.abs(full.time_s - t) > 2 * tick)
                   for p, t in zip(drawn.mm, drawn.time_s, strict=True)]  # fmt: skip
        assert max(float(gaps.min()) for gaps in nearest) <= QUANTUM_MM  # it is a point of the path, at its time


def test_chunks_hold_their_points_and_join(tmp_path: Path) -> None:
    batch = batch_of(rows(200))
    full = level(written(tmp_path, cut_in(batch, 3)), -1)
    assert len(full.index) == 5
    end = 0
    for number, row in enumerate(full.index):
        assert row["count"] <= 8192
        assert row["first"] == end
        end += row["count"]
        mm = full.mm[row["first"] : end]
        assert (mm >= [row["x0"], row["y0"], row["z0"]]).all()
        assert (mm <= [row["x1"], row["y1"], row["z1"]]).all()
        assert row["line0"] <= row["line1"]
        if number:
            before = full.index[number - 1]
            assert (row["t0"], row["line0"]) == (before["t1"], before["line1"])
            assert np.abs(mm[0] - full.mm[row["first"] - 1]).max() <= QUANTUM_MM
    assert end == len(full.mm)
    assert (full.hidden == full.first_of_chunk).all()


def test_a_pause_is_time_at_one_place(tmp_path: Path) -> None:
    points = [[0, 0, 0], [0, 0, 0], [10, 0, 0], [10, 0, 0], [10, 10, 0]]
    batch = batch_of(points, pause_s=[4.0, -1.0, 0.0, -1.0])
    full = level(written(tmp_path, [batch]), -1)
    assert len(full.mm) == 4  # a stop that takes no time is no point
    assert full.time_s[1] == pytest.approx(4.0, abs=0.05)
    assert (full.mm[0] == full.mm[1]).all()


def test_a_program_that_never_moves_is_a_file_too(tmp_path: Path) -> None:
    facts = header(written(tmp_path, []))
    assert facts["levels"][-1]["points"] == 0
    assert facts["bounds_mm"] is None


def test_the_same_moves_make_the_same_bytes_however_they_come(tmp_path: Path) -> None:
    batch = batch_of(rows(300))
    files = []
    for pieces in (1, 2, 7):
        with small_files(5000):
            files.append(written(tmp_path, cut_in(batch, pieces)))
    full = [data[header(data)["levels"][-1]["offset_bytes"] :] for data in files]
    assert full[0] == full[1] == full[2]
    with small_files(5000):
        assert written(tmp_path, cut_in(batch, 7)) == files[2]
    assert [path.name for path in tmp_path.iterdir()] == ["pass-1.path"]


def test_bounds_tell_cuts_from_rapids(tmp_path: Path) -> None:
    batch = batch_of([[0, 0, 5], [10, 0, 5], [10, 0, -2], [20, 0, -2]], rapid=[True, False, False])
    facts = header(written(tmp_path, [batch]))
    assert facts["bounds_mm"]["x"] == [0, 20]
    assert facts["cut_bounds_mm"] == {"x": [10, 20], "y": [0, 0], "z": [-2, -2]}


def test_a_long_pass_is_small_at_a_glance(tmp_path: Path) -> None:
    data = written(tmp_path, cut_in(batch_of(rows(2000)), 9))
    levels = header(data)["levels"]
    assert levels[0]["points"] <= MOST_POINTS < levels[-1]["points"]
    assert [one["points"] for one in levels] == sorted(one["points"] for one in levels)
    assert [one["tolerance_mm"] for one in levels] == sorted((one["tolerance_mm"] for one in levels), reverse=True)
    assert len(data) == levels[-1]["offset_bytes"] + 8 * levels[-1]["points"]


def test_chords_keep_the_ends_of_rapids() -> None:
    kind = np.array([1, 1, 1, 0, 0, 0, 1], dtype=np.uint8)
    mm = np.stack([np.arange(7.0), np.zeros(7), np.zeros(7)], axis=1)
    points = Points(mm=mm, time_s=np.arange(7.0), line=np.arange(7), kind=kind)
    chords = Chords(1.0)
    kept = Points.join([chords.add(points), chords.rest()])
    assert kept.line.tolist() == [0, 2, 5, 6]


def test_a_path_that_comes_back_at_another_depth_is_drawn_again() -> None:
    row = rows(1)
    both = np.concatenate([row, row[::-1] - np.array([0, 0, 0.5])])
    points = Points(mm=both, time_s=np.arange(len(both)) * 1.0, line=np.arange(len(both)),
                    kind=np.zeros(len(both), dtype=np.uint8))  # fmt: skip
    thinner = Thinner(0.1, np.array([both.min(axis=0)[:2], both.max(axis=0)[:2]]))
    assert len(thinner.add(points)) == len(both)
    lifted = row + np.array([0, 0, 1e-3])
    again = Points(mm=lifted, time_s=points.time_s[: len(row)] + 1e3, line=points.line[: len(row)],
                   kind=np.zeros(len(row), dtype=np.uint8))  # fmt: skip
    assert len(thinner.add(again)) <= len(row)
