"""A program may be entered at its restart points: after what a point states, the rest of the text makes the moves that
it makes in the whole program. Layers are found by their depth, rows where they turn outside the lens.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.checking.restarts import LEAST_GAP_S, MOST_POINTS, RestartFinder, RestartPoint, choose_points
from cam.moves import SAFE_Z_MM
from cam.passes import PAPER_PASSES, Stock
from cam.posts.dialects import POSTS
from cam.posts.post import ProgramSetup
from cam.reading.gcode import LANGUAGES
from cam.surface.stock_grid import StockGrid
from machines.gcode.interpreter import Interpreter
from tests.cam.lenses import make_bumps
from tests.cam.programs import generate_program, read_program

WIDTH_MM, HEIGHT_MM = 8.0, 6.0
STOCK = Stock(width_mm=WIDTH_MM, height_mm=HEIGHT_MM, thickness_mm=12.0, margin_mm=4.0)
ROUGH, _, FINISH = PAPER_PASSES
PASSES = {
    "layers": replace(ROUGH, radius_mm=1.0, pitch_mm=0.4, step_down_mm=0.5),
    "rows": replace(FINISH, radius_mm=1.0, pitch_mm=0.1),
    "rows along y": replace(FINISH, radius_mm=1.0, pitch_mm=0.1, direction="y"),
    "rows with lifts": replace(FINISH, radius_mm=1.0, pitch_mm=0.2, link="retract"),
    "contour": replace(FINISH, radius_mm=1.0, pitch_mm=0.1, strategy="contour"),
}


def program(name: str, dialect: str = "linuxcnc") -> bytes:
    lens = make_bumps(3, relief_mm=2.0, width_mm=WIDTH_MM, height_mm=HEIGHT_MM)
    top = StockGrid.block(STOCK, 0.1)
    if name != "layers":
        skin = lens.spline().extend(4.0).heights_mm(top.x_mm[None, :], top.y_mm[:, None]) + 0.05
        top = replace(top, top_mm=np.minimum(skin, top.top_mm))
    setup = ProgramSetup(top_z_mm=0.0)
    pieces = generate_program(lens, PASSES[name], STOCK, stock_top=top, post=POSTS[dialect], setup=setup)
    return b"".join(pieces)


def find_points(text: bytes, dialect: str, axis: int) -> list[RestartPoint]:
    finder = RestartFinder(safe_z_mm=SAFE_Z_MM, axis=axis)
    for batch in read_program([text], LANGUAGES[dialect]):
        finder.add(batch)
    return finder.list_points()


@pytest.mark.parametrize("name", PASSES)
@pytest.mark.parametrize("dialect", ["linuxcnc", "okuma"])
def test_the_rest_of_a_program_moves_as_in_the_whole_after_what_its_point_states(name: str, dialect: str) -> None:
    text = program(name, dialect)
    points = find_points(text, dialect, 1 if name.endswith("y") else 0)
    assert len(points) >= 3
    whole, lines = Interpreter(dialect=dialect), text.splitlines()
    steps = [whole.take(line) for line in lines]
    for point in points[:: max(1, len(points) // 8)]:
        x, y, z = point.at_mm
        by_hand = [
            *("G21G90G17", "G15H1" if dialect == "okuma" else "G54", f"S{point.spindle_rpm:g}M3"),
            *(f"G0Z{SAFE_Z_MM:.5f}", f"G0X{x:.5f}Y{y:.5f}", f"G1Z{z:.5f}F100.0"),
            *(f"G1F{point.feed_mm_per_min:.4f}", "G0" if point.is_rapid else "G1"),
        ]
        mill = Interpreter(dialect=dialect)
        for line in by_hand:
            mill.take(line.encode())
        rest = slice(point.line - 1, point.line + 40)
        for line, step in zip(lines[rest], steps[rest], strict=True):
            again = mill.take(line)
            assert (again.kind, again.feed_mm_per_min) == (step.kind, step.feed_mm_per_min), (point, line)
            if None not in step.end_mm:
                assert again.start_mm == pytest.approx(step.start_mm) and again.end_mm == pytest.approx(step.end_mm)
        assert not point.is_rapid or z >= SAFE_Z_MM - 1e-9


def test_layers_are_those_that_go_deeper_and_begin_over_the_block() -> None:
    points = find_points(program("layers"), "linuxcnc", 0)
    layers = [one for one in points if one.kind == "layer"]
    assert len(layers) >= 3 and all(one.at_mm[2] >= SAFE_Z_MM - 1e-9 for one in layers)


@pytest.mark.parametrize("name", ["rows", "rows along y"])
def test_rows_turn_outside_the_lens_and_there_is_one_for_each(name: str) -> None:
    axis = 1 if name.endswith("y") else 0
    rows = [one for one in find_points(program(name), "linuxcnc", axis) if one.kind == "row"]
    side_mm, across_mm = ((WIDTH_MM, HEIGHT_MM), (HEIGHT_MM, WIDTH_MM))[axis]
    assert all(not 0.0 < one.at_mm[axis] < side_mm for one in rows)
    assert len(rows) == pytest.approx(across_mm / PASSES[name].pitch_mm, rel=0.4)
    steps_mm = np.diff([one.at_mm[1 - axis] for one in rows])
    assert (steps_mm >= 0).all() or (steps_mm <= 0).all()


def test_the_pieces_of_a_text_do_not_matter() -> None:
    """Turns and entries are found across the border of two batches, too."""
    (whole,) = read_program([program("rows")], LANGUAGES["linuxcnc"])
    finder = RestartFinder(safe_z_mm=SAFE_Z_MM, axis=0)
    for low in range(0, len(whole), 7):
        high = min(low + 7, len(whole))
        names = ("is_rapid", "feed_mm_per_min", "line", "spindle_rpm", "pause_s")
        part = {name: getattr(whole, name)[low:high] for name in names}
        finder.add(replace(whole, points_mm=whole.points_mm[low : high + 1], **part))
    assert finder.list_points() == find_points(program("rows"), "linuxcnc", 0)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(["layer", "entry", "row"]), st.floats(0, 5e4)), max_size=80),
    st.floats(1.0, 6e4),
)
def test_a_dozen_is_chosen_with_all_layers_that_fit(found: list[tuple[str, float]], whole_s: float) -> None:
    found = sorted((kind, at_s) for kind, at_s in found if at_s <= whole_s)
    times = {line: at_s for line, (_, at_s) in enumerate(sorted(found, key=lambda one: one[1]), 1)}
    points = [
        RestartPoint(line=line, kind=kind, at_mm=(0, 0, 0), is_rapid=True, feed_mm_per_min=0, spindle_rpm=1)  # type: ignore[arg-type]
        for line, (kind, _) in enumerate(sorted(found, key=lambda one: one[1]), 1)
    ]
    chosen = choose_points(points, times.__getitem__, whole_s)
    layers = [one for one in points if one.kind == "layer"]
    assert len(chosen) <= MOST_POINTS
    assert [one.line for one, _ in chosen] == sorted({one.line for one, _ in chosen})
    assert all(at_s == times[one.line] for one, at_s in chosen)
    if len(layers) <= MOST_POINTS:
        assert set(layers) <= {one for one, _ in chosen}
    others = [at_s for one, at_s in chosen if one.kind != "layer"]
    assert all(LEAST_GAP_S <= at_s <= whole_s - LEAST_GAP_S for at_s in others)
