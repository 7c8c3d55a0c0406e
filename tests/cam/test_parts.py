"""A pass in several programs: each whole in itself, together the same cut, no gap where one goes on from another."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.check import check_program
from cam.duration import Kinematics
from cam.moves import CLEARANCE_MM, Path, cut, rapid
from cam.parts import OVERLAP_MM, PartLimits, PassFrame, programs
from cam.passes import Stock, ball_pass
from cam.posts.dialects import GRBL, POSTS
from cam.program import generate_parts
from cam.reading.gcode import LANGUAGES
from cam.surface.stock_grid import StockGrid
from machines.preflight.preflight import limits_of
from machines.profile import load_profile
from service.milling.preflight_child import examine
from tests.cam.lenses import make_bumps
from tests.cam.programs import read_program

SAFE_Z = 5.0
FRAME = PassFrame(
    remarks=("pass tiny",), rpm=9000, plunge_mm_per_min=200, safe_z_mm=SAFE_Z, aperture_mm=(10.0, 10.0), number=3
)
KINEMATICS = Kinematics(
    max_rate_mm_per_min=(3000.0, 3000.0, 1500.0),
    acceleration_mm_per_s2=(400.0, 400.0, 200.0),
    junction_deviation_mm=0.01,
    planner_blocks=16,
    lines_per_s=400.0,
)


def one_cut(n: int, *, seed: int = 0) -> list[Path]:
    """One entry, n short moves through the aperture and beside it, one lift."""
    t = np.linspace(0, n / 60, n)
    points = np.column_stack([5 + 6 * np.sin(t), 5 + 4 * np.cos(0.7 * t + seed), -1 + 0.3 * np.sin(3 * t)])
    down = (*points[0, :2], 1.0)
    return [
        rapid((*points[0, :2], SAFE_Z), down),
        cut(points[:1], 200),
        cut(points[1:], 600),
        rapid((*points[-1, :2], SAFE_Z)),
    ]


def texts(paths: list[Path], limits: PartLimits, dialect: str = "grbl") -> list[bytes]:
    return [b"".join(text) for text in programs(paths, POSTS[dialect], FRAME, limits)]


def moves(text: bytes, dialect: str = "grbl") -> tuple[np.ndarray, np.ndarray]:
    """(end points, is rapid) of all moves of a program read by itself."""
    batches = list(read_program([text], LANGUAGES[dialect]))
    assert batches[-1].ended and not batches[-1].spindle_on[-1]
    ends = np.concatenate([batch.end_mm[batch.pause_s < 0] for batch in batches])
    return ends, np.concatenate([batch.is_rapid[batch.pause_s < 0] for batch in batches])


@settings(max_examples=12, deadline=None)
@given(st.integers(300, 1500), st.integers(12_000, 30_000), st.sampled_from(sorted(POSTS)))
def test_parts_keep_their_limit_and_cut_every_move_of_the_whole(n, most_bytes, dialect):
    paths = one_cut(n)
    whole, _ = moves(texts(paths, PartLimits(), dialect)[0], dialect)
    parts = texts(paths, PartLimits(most_bytes=most_bytes), dialect)
    assert max(map(len, parts)) <= most_bytes
    found = np.vstack([moves(part, dialect)[0] for part in parts])
    steps = {(*a, *b) for a, b in itertools.pairwise(found)}
    assert all((*a, *b) in steps for a, b in itertools.pairwise(whole))


def test_a_part_comes_down_in_the_slot_and_goes_over_the_last_millimetre_again():
    parts = texts(one_cut(3000), PartLimits(most_bytes=20_000))
    assert len(parts) > 2
    for before, after in itertools.pairwise(parts):
        ended, rapids = moves(before)
        stood = ended[-2]
        assert rapids[-1] and ended[-1][2] == SAFE_Z and (ended[-1][:2] == stood[:2]).all()
        again, fast = moves(after)
        reached = int(np.flatnonzero((again == stood).all(axis=1))[0])
        down = int(np.argmin(fast))
        assert fast[:down].all() and not fast[down : reached + 1].any()
        way = again[down : reached + 1]
        exact = [k for k in range(len(way)) if (np.abs(ended - way[k]).max(axis=1) < 1e-9).any()]
        first_exact = way[min(exact) :]
        assert np.linalg.norm(np.diff(first_exact, axis=0), axis=1).sum() > 0.8 * OVERLAP_MM
        # Above the path all the way down, and on it at the end.
        for x, y, z in way:
            near = np.argmin(np.hypot(ended[:-1, 0] - x, ended[:-1, 1] - y))
            assert -0.03 <= z - ended[near, 2] <= CLEARANCE_MM + 0.03


def test_a_lift_that_is_there_anyway_is_taken_first():
    """Rows of their own entries: no part adds an entry."""
    rows = [path for seed in range(40) for path in one_cut(40, seed=seed)]
    parts = texts(rows, PartLimits(most_bytes=12_000))
    assert len(parts) > 1
    entries = sum(text.count(b"F200") for text in parts)
    assert entries == 40


def test_hours_split_as_well_and_the_edge_is_preferred():
    """The cut leaves the aperture every two hundred moves, and 7 % of a part's time are four hundred."""
    paths = one_cut(20_000)
    length_mm = np.linalg.norm(np.diff(paths[2].points_mm, axis=0), axis=1).sum()
    parts = texts(paths, PartLimits(most_s=length_mm / 10 / 3.5, most_bytes=1e6))
    assert len(parts) == 4
    for part in parts[:-1]:
        x, y = moves(part)[0][-1][:2]
        assert not (0 < x < 10 and 0 < y < 10)


def test_names_and_numbers_tell_the_parts_apart():
    parts = texts(one_cut(2000), PartLimits(most_bytes=20_000), "okuma")
    assert [part.split(b"\r\n")[1] for part in parts][:2] == [b"O0301", b"O0302"]
    assert b"PART 2: GOES ON WHERE PART 1 HAS ENDED" in parts[1]
    assert texts(one_cut(50), PartLimits()) == texts(one_cut(50), PartLimits(most_bytes=1e6))


@pytest.mark.thorough
@pytest.mark.parametrize("dialect", ["grbl", "fanuc", "rml-1"])
def test_a_split_pass_leaves_the_same_stock_and_each_part_may_run_alone(tmp_path, dialect):
    lens = make_bumps(4, relief_mm=0.5, width_mm=3.0, height_mm=2.0)
    stock = Stock(width_mm=3.0, height_mm=2.0, thickness_mm=10, margin_mm=1.5)
    top = StockGrid.block(stock, 0.08)
    spec = replace(
        ball_pass("finish", radius_mm=0.8, pitch_mm=0.08, stock_to_leave_mm=0.0, step_down_mm=0.8), spindle_rpm=8000
    )
    post = POSTS[dialect]
    found = []
    for limits in (PartLimits(), PartLimits(most_bytes=30_000)):
        pieces = generate_parts(lens, spec, stock, stock_top=top, post=post, limits=limits)
        parts = [b"".join(piece) for piece in pieces]
        verdict = check_program(
            [parts[0]],
            further=[[part] for part in parts[1:]],
            language=LANGUAGES[dialect],
            digit_mm=post.digits.z_mm,
            heightfield=lens,
            spec=spec,
            stock=stock,
            stock_top=top,
            kinematics=KINEMATICS,
            safe_z_mm=SAFE_Z,
        )
        assert verdict.ok, verdict.faults
        found.append((parts, verdict))
    (_, whole), (parts, split) = found
    assert len(parts) > 2
    np.testing.assert_allclose(split.stock_top.top_mm, whole.stock_top.top_mm, atol=2e-3)  # it batches short moves
    assert split.entries <= whole.entries + len(parts) - 1
    assert split.gouge_um == pytest.approx(whole.gouge_um, abs=1e-6)
    profile = replace(load_profile("roland-mdx-40a"), dialect=dialect)
    for number, part in enumerate(parts):
        file = tmp_path / f"part-{number}{post.suffix}"
        file.write_bytes(part)
        assert examine(file, limits_of(profile), lambda share: None).ends
    assert GRBL.digits.z_mm < 1e-4
