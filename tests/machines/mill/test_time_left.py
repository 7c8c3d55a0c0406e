"""The time left is time, not lines: rows of ten seconds and curves of a hundred lines a second are told apart."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.preflight.preflight import Preflight, limits_of
from machines.preflight.timeline import KNOTS, compute_time_at_s, thin_out
from machines.profile import load_profile
from machines.runs import RunState
from service.milling.preflight_child import examine
from tests.machines.shop import YES, Shop

HEAD = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 Z5", "G0 X0 Y0", "G1 Z-1 F300"]
ROWS = [f"G1 X{100 if k % 2 == 0 else 0} Y{k} F900" for k in range(30)]
CURVE = [f"G1 X{0.05 * k:.3f} Y29 F900" for k in range(1, 1500)]
ROW_S = 100 / 900 * 60
TAIL = ["G0 Z5", "M5", "M2"]


@pytest.mark.parametrize("body", [ROWS + CURVE, CURVE + ROWS], ids=["rows first", "curve first"])
def test_the_time_left_falls_as_time_passes_and_does_not_jump(tmp_path: Path, body: list[str]) -> None:
    shop = Shop(tmp_path, [*HEAD, *body, *TAIL])
    facts = examine(shop.path, limits_of(load_profile("grbl"), shop.mill.snapshot.settings), lambda _: None)
    assert Preflight.from_json(facts.to_json()).timeline == facts.timeline and len(facts.timeline) <= KNOTS
    shop.id = shop.mill.park(facts, shop.path, "part").id
    shop.mill.start(shop.id, YES)
    seen, begun_s = [], shop.bench.sim.now_s
    while shop.state is not RunState.FINISHED:
        shop.pass_s(2.0)
        seen.append((shop.bench.sim.now_s, shop.mill.run(shop.id).time_left_s, shop.mill.run(shop.id).share))
    end_s = seen[-1][0]
    for now_s, left_s, share in seen[3:-1]:
        assert share == pytest.approx((now_s - begun_s) / (end_s - begun_s), abs=3 * ROW_S / (end_s - begun_s))
        assert left_s == pytest.approx(end_s - now_s, abs=3 * ROW_S), now_s
    jumps_s = [abs((a[1] - b[1]) - (b[0] - a[0])) for a, b in pairwise(seen[3:-1])]
    assert max(jumps_s) < 3 * ROW_S  # a row counts when a position has proved its end


@given(
    steps=st.lists(st.tuples(st.integers(1, 500), st.floats(0.0, 90.0)), min_size=1, max_size=600),
    most=st.integers(1, 200),
)
def test_knots_rise_keep_the_last_and_are_met(steps: list[tuple[int, float]], most: int) -> None:
    line, at_s, knots = 0, 0.0, []
    for lines, seconds in steps:
        line, at_s = line + lines, round(at_s + seconds, 2)
        knots.append((line, at_s))
    thinned = thin_out(knots, most)
    assert len(thinned) <= most and thinned[-1] == knots[-1] and set(thinned) <= set(knots)
    times = [compute_time_at_s(thinned, number, lines=line, time_s=at_s) for number, _ in [(0, 0), *knots]]
    assert times == sorted(times) and (times[0], times[-1]) == (0.0, at_s)
    for number, seconds in thinned:
        assert compute_time_at_s(thinned, number, lines=line, time_s=at_s) == pytest.approx(seconds)
