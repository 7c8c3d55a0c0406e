"""Where the rules of `cam.checking.envelope` find nothing, no motion of any program, from any place where the tool may
be parked, meets table, block, clamps or gantry, and the head stays within its travel.

The motions are followed here step by step through boxes and cylinders, from the programs' text; nothing of the rules is
used for it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st

from cam.around.paths import (
    aperture_corners,
    make_cut_out_paths,
    make_facing_paths,
    make_witness_paths,
    offset_loop,
    trace_paths,
)
from cam.around.specs import BESIDE_MM, CutOut, Facing, WitnessCut
from cam.checking.envelope import ABOVE_CLAMPS_MM, Envelope, Reach
from cam.moves import Path
from cam.parts import PartLimits, PassFrame, programs
from cam.passes import Clamp, PassSpec, Stock, ball_pass
from cam.posts.dialects import POSTS
from cam.posts.post import ProgramSetup
from cam.program import pass_paths
from cam.surface.stock_grid import StockGrid
from tests.cam.lenses import make_bumps, make_lens
from tests.levels import THOROUGH, mostly_thorough

WIDTH, HEIGHT, MARGIN = 8.0, 6.0, 14.0
TOP_MM = 1.0  # of the raw block, where it is faced
SAFE = (5.0, 12.0, 26.0)
ROUGH = ball_pass("rough", radius_mm=2.0, pitch_mm=1.0, stock_to_leave_mm=0.2, step_down_mm=1.0)
FINISH = ball_pass("finish", radius_mm=1.0, pitch_mm=0.8, stock_to_leave_mm=0.0, step_down_mm=0.8)
SMALL = ball_pass("rest", radius_mm=0.5, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.2)
FACING = Facing(
    above_mm=TOP_MM, shape="flat", radius_mm=3, pitch_mm=4, step_down_mm=0.5, feed_mm_per_min=1000,
    plunge_mm_per_min=300, spindle_rpm=12000,
)  # fmt: skip
WITNESS = WitnessCut(
    radius_mm=FINISH.radius_mm, along="x", places_mm=tuple(1.0 + 0.5 * k for k in range(13)), tips_mm=(-0.15,) * 13,
    across_mm=(-12.0, -6.0), step_down_mm=0.8, feed_mm_per_min=600, plunge_mm_per_min=200, spindle_rpm=12000,
)  # fmt: skip
CUT_OUT = CutOut(
    radius_mm=1.5, tabs=2, tab_width_mm=2, tab_height_mm=1, through_mm=0.5, step_down_mm=3, feed_mm_per_min=500,
    plunge_mm_per_min=200, spindle_rpm=12000,
)  # fmt: skip
SPECS: dict[str, Facing | WitnessCut | CutOut | PassSpec] = {
    "face": FACING,
    "rough": ROUGH,
    "flat rough": replace(ROUGH, corner_radius_mm=0.0),
    "finish": FINISH,
    "finish along Y": replace(FINISH, direction="y", link="retract"),
    "second part": FINISH,
    "contour": replace(FINISH, strategy="contour"),
    "rest": replace(SMALL, where="rest"),
    "witness": WITNESS,
    "cut-out": CUT_OUT,
}
LENS = make_bumps(5, relief_mm=3.0, width_mm=WIDTH, height_mm=HEIGHT)
THICKNESS_MM = (8.0, 15.0, 30.0)
PLACES = st.floats(-60, 60)


def stock_of(thickness_mm: float) -> Stock:
    return Stock(width_mm=WIDTH, height_mm=HEIGHT, thickness_mm=thickness_mm, margin_mm=MARGIN)


def slope(x, y):
    return -0.3 + 0.02 * x + 0 * y


def slope_with_pit(x, y):
    """The slope with a pit that only a small ball fits into."""
    return slope(x, y) - 0.1 * np.exp(-((x - 6.0) ** 2 + (y - 2.0) ** 2) / (2 * 0.08))


@cache
def paths_of(kind: str, safe_z_mm: float, thickness_mm: float) -> tuple[Path, ...]:
    spec, stock = SPECS[kind], stock_of(thickness_mm)
    if isinstance(spec, Facing):
        return tuple(make_facing_paths(spec, stock, safe_z_mm=safe_z_mm))
    if isinstance(spec, WitnessCut):
        return tuple(make_witness_paths(spec, top_mm=0.0, safe_z_mm=safe_z_mm))
    if isinstance(spec, CutOut):
        loop = offset_loop(aperture_corners(stock), spec.radius_mm)
        return tuple(make_cut_out_paths(spec, stock, loop, top_mm=0.0, safe_z_mm=safe_z_mm))
    lens, top = LENS, StockGrid.block(stock, 0.1)
    if spec.where == "rest":  # a larger ball has cut the slope, and the margin beside it
        lens = make_lens(slope_with_pit, width_mm=WIDTH, height_mm=HEIGHT, per_mm=20)
        top = replace(top, top_mm=np.minimum(slope(top.x_mm[None, :], top.y_mm[:, None]), 0.0))
    return tuple(pass_paths(lens, spec, stock, stock_top=top, safe_z_mm=safe_z_mm, slope_error_rad=0.03))


@cache
def text_of(kind: str, safe_z_mm: float, thickness_mm: float, *, raised: bool) -> str:
    """A program as it is written, with a trace of the block in the air before it."""
    frame = PassFrame(
        remarks=(), rpm=12000, plunge_mm_per_min=300, safe_z_mm=safe_z_mm, aperture_mm=(WIDTH, HEIGHT),
        setup=ProgramSetup(top_z_mm=0.0 if raised else None),
        trace=trace_paths(stock_of(thickness_mm), (), safe_z_mm=safe_z_mm, feed_mm_per_min=1000),
    )  # fmt: skip
    limits = PartLimits(most_bytes=3000) if kind == "second part" else None
    paths = paths_of(kind, safe_z_mm, thickness_mm if kind == "cut-out" else THICKNESS_MM[-1])
    texts = [b"".join(part) for part in programs(paths, POSTS["linuxcnc" if raised else "grbl"], frame, limits)]
    assert (len(texts) > 1) == (kind == "second part")
    return texts[-1 if len(texts) == 1 else 1].decode()


@cache
def motions(text: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each motion, whether it is a rapid, its end (n, 3), NaN where an axis stays, and whether it is in machine
    coordinates, whose Z0 is where the collet is at its top.
    """
    rapid, rapids, ends, raised = True, [], [], []
    for line in text.splitlines():
        words = re.findall(r"([A-Z])(-?[\d.]+)", re.sub(r"\(.*?\)", "", line))
        goes = [float(value) for letter, value in words if letter == "G"]
        rapid = 0.0 in goes or (rapid and 1.0 not in goes)
        end = [next((float(value) for letter, value in words if letter == axis), np.nan) for axis in "XYZ"]
        if not np.isnan(end).all():
            rapids.append(rapid)
            ends.append(end)
            raised.append(53.0 in goes)
    return np.array(rapids), np.array(ends), np.array(raised)


def places(text: str, parked_mm: np.ndarray, top_tip_mm: float) -> np.ndarray:
    """Where the tip is at the beginning and after each motion (n, 3)."""
    _, ends, raised = motions(text)
    points = np.vstack([parked_mm, ends + np.where(raised, top_tip_mm, 0.0)[:, None] * [0, 0, 1]])
    for axis in range(3):  # a coordinate that a line leaves out stays
        said = np.maximum.accumulate(np.where(np.isnan(points[:, axis]), 0, np.arange(len(points))))
        points[:, axis] = points[said, axis]
    return points


@cache
def lowest_in(text: str) -> float:
    _, ends, raised = motions(text)
    return min(0.0, float(np.nanmin(ends[~raised, 2])))


def reach_of(kind: str, text: str, **clamped: float | None) -> Reach:
    """Where a program of that kind may take its tool, in the words of the rules."""
    spec, lowest_mm = SPECS[kind], lowest_in(text)
    if isinstance(spec, WitnessCut):
        return Reach(
            radius_mm=spec.radius_mm, beyond_mm=(0, 0), strip_mm=spec.box_mm, lowest_mm=lowest_mm, **clamped
        )  # fmt: skip
    beyond_mm = (MARGIN + spec.radius_mm + BESIDE_MM, MARGIN) if kind == "face" else (spec.radius_mm + 0.01,) * 2
    return Reach(radius_mm=spec.radius_mm, beyond_mm=beyond_mm, lowest_mm=lowest_mm, **clamped)


def strikes(envelope: Envelope, base_mm: float, reach: Reach, stick_out_mm: float, text: str, parked_mm) -> list[str]:
    """What is met, or left, on the way; a parked tool that already meets something is not followed."""
    assert envelope.bed_to_collet_mm is not None
    table_mm = -envelope.thickness_mm - base_mm
    top_tip_mm = envelope.bed_to_collet_mm + table_mm - stick_out_mm
    high_mm = np.array([WIDTH + MARGIN, HEIGHT + MARGIN, envelope.top_mm])
    block = (np.array([-MARGIN, -MARGIN, table_mm]), high_mm)
    boxes = [
        (np.array([c.x_mm, c.y_mm, table_mm]), np.array([c.x_mm + c.width_mm, c.y_mm + c.depth_mm, c.height_mm]))
        for c in envelope.clamps
    ]
    nose, over = [], stick_out_mm
    for radius_mm, length_mm in envelope.nose_mm:
        nose.append((radius_mm, over))
        over += length_mm

    def meets(box, at_mm, radius_mm, over_mm) -> bool:
        low, high = box
        away = np.linalg.norm(np.maximum(np.maximum(low - at_mm, at_mm - high)[:, :2], 0), axis=1)
        return bool(((away < radius_mm) & (at_mm[:, 2] + over_mm < high[2] - 1e-6)).any())

    def judge(at_mm, rapids) -> Iterator[str]:
        low, high = at_mm[:, 2].min(), at_mm[:, 2].max()
        if low < table_mm - 1e-6:
            yield "table"
        if high > top_tip_mm + 1e-6 or low < top_tip_mm - envelope.travel_z_mm - 1e-6:
            yield "travel"
        for radius_mm, over_mm in nose:
            if any(meets(box, at_mm, radius_mm, over_mm) for box in (block, *boxes)):
                yield "nose"
        if any(meets(box, at_mm, reach.widest_mm, 0.0) for box in boxes):
            yield "clamp"
        if meets(block, rapids, reach.radius_mm, 0.0):
            yield "block"

    if list(judge(parked_mm[None], parked_mm[None])):
        return ["parked"]
    highest_mm = max(high_mm[2], *(high[2] for _, high in boxes), 0.0) - table_mm
    if envelope.gantry_mm is not None and highest_mm > envelope.gantry_mm:
        return ["gantry"]
    points = places(text, parked_mm, top_tip_mm)
    start, end = points[:-1], points[1:]
    steps = np.ceil(np.linalg.norm(end - start, axis=1) / 1.0).astype(int) + 1
    share = np.concatenate([np.linspace(0, 1, count) for count in steps])[:, None]
    way = np.repeat(start, steps, axis=0) + share * np.repeat(end - start, steps, axis=0)
    is_up = (end[:, 2] > start[:, 2]) & (end[:, :2] == start[:, :2]).all(axis=1)
    fast = np.repeat(motions(text)[0] & ~is_up, steps)  # straight up it leaves its own slot
    return list(judge(way, way[fast]))


@st.composite
def scenes(draw, kind: str) -> tuple[Envelope, str, Reach, float]:
    """An envelope, a program of that kind for it with its reach, and a base."""
    clamps = tuple(
        Clamp(x_mm=x, y_mm=y, width_mm=w, depth_mm=d, height_mm=h)
        for x, y, w, d, h in draw(
            st.lists(
                st.tuples(PLACES, PLACES, st.floats(1, 40), st.floats(1, 40), st.sampled_from([0.5, 3.0, 10.0, 25.0])),
                max_size=2,
            )
        )
    )
    thickness_mm = draw(st.sampled_from(THICKNESS_MM))
    need_mm = max([5.0, *(clamp.height_mm + ABOVE_CLAMPS_MM for clamp in clamps)])
    safe_z_mm = next(safe for safe in SAFE if safe >= need_mm)
    nose = draw(st.lists(st.tuples(st.floats(2, 40), st.floats(1, 40)), min_size=1, max_size=3))
    nose = [(max(radius for radius, _ in nose[: k + 1]), length) for k, (_, length) in enumerate(nose)]
    envelope = Envelope(
        width_mm=WIDTH, height_mm=HEIGHT, margin_mm=MARGIN, thickness_mm=thickness_mm, safe_z_mm=safe_z_mm,
        travel_z_mm=draw(st.floats(45, 150)), top_mm=TOP_MM if kind == "face" else 0.0,
        through_mm=CUT_OUT.through_mm if kind == "cut-out" else 0.0, clamps=clamps,
        bed_to_collet_mm=thickness_mm + draw(st.floats(20, 200)),
        gantry_mm=draw(st.none() | st.floats(30, 150)), nose_mm=tuple(nose),
    )  # fmt: skip
    text = text_of(kind, safe_z_mm, thickness_mm, raised=draw(st.booleans()))
    reach = reach_of(kind, text, flute_length_mm=draw(st.none() | st.just(5.0)))
    if draw(st.booleans()):
        more_mm = draw(st.floats(0, 20))
        reach = replace(reach, stick_out_mm=envelope.least_stick_out_mm(reach) + more_mm)
    least_mm, most_mm = envelope.base_range_mm([reach])
    assume(not list(envelope.find_struck(reach)) and max(least_mm, 0.0) <= most_mm)
    share = draw(st.sampled_from([0.0, 1.0]) | st.floats(0, 1))
    return envelope, text, reach, max(least_mm, 0.0) + share * (min(most_mm, 300.0) - max(least_mm, 0.0))


@pytest.mark.parametrize("kind", SPECS)
@settings(max_examples=50 if THOROUGH else 6, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(data=st.data(), x=PLACES, y=PLACES, share=st.floats(0, 1))
def test_no_motion_of_a_program_that_fits_meets_anything(kind, data, x, y, share) -> None:
    envelope, text, reach, base_mm = data.draw(scenes(kind))
    stick_out_mm = envelope.stick_out_mm(reach)
    top_tip_mm = envelope.bed_to_collet_mm - envelope.thickness_mm - base_mm - stick_out_mm
    parked_mm = np.array([x, y, top_tip_mm - share * envelope.travel_z_mm])
    assert strikes(envelope, base_mm, reach, stick_out_mm, text, parked_mm) in ([], ["parked"])


def make_fit(kind: str = "finish") -> tuple[Envelope, Reach, str]:
    """A program for a block with a clamp at its left, on a mill that just has room for it."""
    text = text_of(kind, 12.0, 15.0, raised=False)
    reach = reach_of(kind, text)
    left, _, front, back = reach.strip_mm or (-reach.beyond_mm[0], WIDTH, 0.0, HEIGHT)
    clamp = Clamp(x_mm=left - 29.0, y_mm=front, width_mm=20.0, depth_mm=back - front, height_mm=10.0)
    envelope = Envelope(
        width_mm=WIDTH, height_mm=HEIGHT, margin_mm=MARGIN, thickness_mm=15.0, safe_z_mm=12.0, travel_z_mm=60.0,
        clamps=(clamp,), through_mm=CUT_OUT.through_mm if kind == "cut-out" else 0.0, bed_to_collet_mm=80.0,
        top_mm=TOP_MM if kind == "face" else 0.0, nose_mm=((12.0, 20.0), (20.0, 50.0)),
    )  # fmt: skip
    return envelope, reach, text


@pytest.mark.parametrize("kind", mostly_thorough(SPECS, quick=("finish", "contour", "rest", "witness")))
@pytest.mark.parametrize(
    ("change", "met"),
    [
        ("short tool", "nose"),
        ("high base", "travel"),
        ("low base", "travel"),
        ("near clamp", "clamp"),
        ("high clamp", "clamp"),
        ("gantry", "gantry"),
    ],
)
def test_what_the_rules_refuse_does_meet_something(change: str, met: str, kind: str) -> None:
    """Each rule broken: the same motions strike."""
    envelope, reach, text = make_fit(kind)
    stick_out_mm = envelope.least_stick_out_mm(reach)
    (least_mm, most_mm), base_mm = envelope.base_range_mm([reach]), 20.0
    parked_mm = np.array([60.0, 60.0, 11.0])
    assert least_mm <= base_mm <= most_mm and not list(envelope.find_struck(reach))
    assert strikes(envelope, base_mm, reach, stick_out_mm, text, parked_mm) == []
    (clamp,) = envelope.clamps
    if change == "short tool":
        stick_out_mm = envelope.top_mm - reach.lowest_mm - 0.1
    elif change == "high base":
        base_mm = most_mm + 0.1
    elif change == "low base":
        envelope = replace(envelope, travel_z_mm=30.0)
        base_mm = envelope.base_range_mm([reach])[0] - 0.1
    elif change == "near clamp":
        at_mm = places(text, parked_mm, top_tip_mm=30.0)
        right_mm = at_mm[at_mm[:, 2] < clamp.height_mm, 0].min() - reach.radius_mm / 2
        envelope = replace(envelope, clamps=(replace(clamp, x_mm=right_mm - clamp.width_mm),))
        assert list(envelope.find_struck(reach))
    elif change == "high clamp":
        envelope = replace(envelope, clamps=(replace(clamp, width_mm=50.0, height_mm=12.5),))
        assert list(envelope.find_struck(reach))
    else:
        envelope = replace(envelope, gantry_mm=15.0 + base_mm + 10.0 - 0.1)
        assert envelope.base_range_mm([reach])[1] < base_mm
    assert met in strikes(envelope, base_mm, reach, stick_out_mm, text, parked_mm)


def test_a_table_that_is_cut_into_is_met() -> None:
    envelope, reach, text = make_fit("cut-out")
    envelope = replace(envelope, clamps=(), bed_to_collet_mm=60.0)
    assert envelope.base_range_mm([reach])[0] >= 0.5
    parked_mm = np.array([40.0, 40.0, 11.0])
    assert "table" in strikes(envelope, 0.4, reach, envelope.least_stick_out_mm(reach), text, parked_mm)


def test_plan_check_and_sheet_ask_for_the_same_stick_out() -> None:
    """Deepest cut, what stands under the nose, and a clearance; never so little that the flutes are clamped."""
    envelope, reach, _ = make_fit()
    assert envelope.least_stick_out_mm(reach) == pytest.approx(2.0 - reach.lowest_mm + 10.0)
    far = replace(envelope, clamps=(replace(envelope.clamps[0], x_mm=-100.0),))
    assert far.least_stick_out_mm(reach) == pytest.approx(max(2.0 - reach.lowest_mm, 4.0 * reach.radius_mm))
    assert far.least_stick_out_mm(replace(reach, flute_length_mm=30.0)) == 30.0
