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

from cam.around.paths import aperture_corners, make_cut_out_paths, make_facing_paths, offset_loop, trace_paths
from cam.around.specs import BESIDE_MM, CutOut, Facing
from cam.checking.envelope import ABOVE_CLAMPS_MM, Envelope, Reach
from cam.parts import PassFrame, programs
from cam.passes import Clamp, Stock, ball_pass
from cam.posts.dialects import POSTS
from cam.posts.post import ProgramSetup
from cam.program import pass_paths
from cam.surface.stock_grid import StockGrid
from tests.cam.lenses import make_bumps

WIDTH, HEIGHT, MARGIN = 8.0, 6.0, 14.0
TOP_MM = 1.0  # of the raw block, where it is faced
SAFE = (5.0, 12.0, 26.0)
ROUGH = ball_pass("rough", radius_mm=2.0, pitch_mm=1.0, stock_to_leave_mm=0.2, step_down_mm=1.0)
FINISH = ball_pass("finish", radius_mm=1.0, pitch_mm=0.8, stock_to_leave_mm=0.0, step_down_mm=0.8)
FACING = Facing(
    above_mm=TOP_MM, shape="flat", radius_mm=3, pitch_mm=4, step_down_mm=0.5, feed_mm_per_min=1000,
    plunge_mm_per_min=300, spindle_rpm=12000,
)  # fmt: skip
CUT_OUT = CutOut(
    radius_mm=1.5, tabs=2, tab_width_mm=2, tab_height_mm=1, through_mm=0.5, step_down_mm=3, feed_mm_per_min=500,
    plunge_mm_per_min=200, spindle_rpm=12000,
)  # fmt: skip
LENS = make_bumps(5, relief_mm=3.0, width_mm=WIDTH, height_mm=HEIGHT)
KINDS = ("face", "rough", "finish", "cut-out")
PLACES = st.floats(-60, 60)


def stock_of(thickness_mm: float) -> Stock:
    return Stock(width_mm=WIDTH, height_mm=HEIGHT, thickness_mm=thickness_mm, margin_mm=MARGIN)


@cache
def text_of(kind: str, safe_z_mm: float, thickness_mm: float, *, raised: bool) -> str:
    """A program as it is written, with a trace of the block in the air before it."""
    stock = stock_of(thickness_mm)
    if kind == "face":
        paths, spec = make_facing_paths(FACING, stock, safe_z_mm=safe_z_mm), FACING
    elif kind == "cut-out":
        loop = offset_loop(aperture_corners(stock), CUT_OUT.radius_mm)
        paths, spec = make_cut_out_paths(CUT_OUT, stock, loop, top_mm=0.0, safe_z_mm=safe_z_mm), CUT_OUT
    else:
        spec = ROUGH if kind == "rough" else FINISH
        paths = pass_paths(LENS, spec, stock, stock_top=StockGrid.block(stock, 0.1), safe_z_mm=safe_z_mm)
    frame = PassFrame(
        remarks=(), rpm=12000, plunge_mm_per_min=300, safe_z_mm=safe_z_mm, aperture_mm=(WIDTH, HEIGHT),
        setup=ProgramSetup(top_z_mm=0.0 if raised else None),
        trace=trace_paths(stock, (), safe_z_mm=safe_z_mm, feed_mm_per_min=1000),
    )  # fmt: skip
    (text,) = [b"".join(part) for part in programs(paths, POSTS["linuxcnc" if raised else "grbl"], frame)]
    return text.decode()


def motions(text: str, parked_mm: np.ndarray, top_tip_mm: float) -> Iterator[tuple[bool, np.ndarray, np.ndarray]]:
    """Whether each is a rapid, its start and its end; machine Z0 is where the collet is at its top."""
    at, rapid = parked_mm.copy(), True
    for line in text.splitlines():
        words = re.findall(r"([A-Z])(-?[\d.]+)", re.sub(r"\(.*?\)", "", line))
        goes = [float(value) for letter, value in words if letter == "G"]
        rapid = 0.0 in goes or (rapid and 1.0 not in goes)
        end = at.copy()
        for letter, value in words:
            if letter in "XYZ":
                end["XYZ".index(letter)] = float(value) + (top_tip_mm if 53.0 in goes else 0.0)
        if (end != at).any():
            yield rapid, at, end
        at = end


def reach_of(kind: str, text: str, **clamped: float | None) -> Reach:
    lowest_mm = min(float(z) for z in re.findall(r"(?<!53G0)Z(-?[\d.]+)", re.sub(r"G53G0Z\S+", "", text)))
    spec = {"face": FACING, "rough": ROUGH, "finish": FINISH, "cut-out": CUT_OUT}[kind]
    beyond_mm = (MARGIN + FACING.radius_mm + BESIDE_MM, MARGIN) if kind == "face" else (spec.radius_mm + 0.01,) * 2
    return Reach(radius_mm=spec.radius_mm, beyond_mm=beyond_mm, lowest_mm=min(lowest_mm, 0.0), **clamped)


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

    def meets(box, places, radius_mm, over_mm) -> bool:
        low, high = box
        away = np.linalg.norm(np.maximum(np.maximum(low - places, places - high)[:, :2], 0), axis=1)
        return bool(((away < radius_mm) & (places[:, 2] + over_mm < high[2] - 1e-6)).any())

    def judge(places, rapids) -> Iterator[str]:
        low, high = places[:, 2].min(), places[:, 2].max()
        if low < table_mm - 1e-6:
            yield "table"
        if high > top_tip_mm + 1e-6 or low < top_tip_mm - envelope.travel_z_mm - 1e-6:
            yield "travel"
        for radius_mm, over_mm in nose:
            if any(meets(box, places, radius_mm, over_mm) for box in (block, *boxes)):
                yield "nose"
        if any(meets(box, places, reach.widest_mm, 0.0) for box in boxes):
            yield "clamp"
        if meets(block, rapids, reach.radius_mm, 0.0):
            yield "block"

    if list(judge(parked_mm[None], parked_mm[None])):
        return ["parked"]
    highest_mm = max(high_mm[2], *(high[2] for _, high in boxes), 0.0) - table_mm
    if envelope.gantry_mm is not None and highest_mm > envelope.gantry_mm:
        return ["gantry"]
    every, rapids = [parked_mm[None]], [np.empty((0, 3))]
    for rapid, start, end in motions(text, parked_mm, top_tip_mm):
        steps = int(np.ceil(np.linalg.norm(end - start) / 1.0)) + 1
        every.append(start + np.linspace(0, 1, steps)[:, None] * (end - start))
        if rapid and not (end[2] > start[2] and (end[:2] == start[:2]).all()):  # straight up it leaves its own slot
            rapids.append(every[-1])
    return list(judge(np.concatenate(every), np.concatenate(rapids)))


@st.composite
def scenes(draw) -> tuple[Envelope, str, str, Reach, float]:
    """An envelope, a program for it with its name and reach, and a base."""
    clamps = tuple(
        Clamp(x_mm=x, y_mm=y, width_mm=w, depth_mm=d, height_mm=h)
        for x, y, w, d, h in draw(
            st.lists(
                st.tuples(PLACES, PLACES, st.floats(1, 40), st.floats(1, 40), st.sampled_from([0.5, 3.0, 10.0, 25.0])),
                max_size=2,
            )
        )
    )
    kind, thickness_mm = draw(st.sampled_from(KINDS)), draw(st.sampled_from([8.0, 15.0, 30.0]))
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
    return envelope, kind, text, reach, max(least_mm, 0.0) + share * (min(most_mm, 300.0) - max(least_mm, 0.0))


@settings(max_examples=40, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(scene=scenes(), x=PLACES, y=PLACES, share=st.floats(0, 1))
def test_no_motion_of_a_program_that_fits_meets_anything(scene, x, y, share) -> None:
    envelope, _, text, reach, base_mm = scene
    stick_out_mm = envelope.stick_out_mm(reach)
    top_tip_mm = envelope.bed_to_collet_mm - envelope.thickness_mm - base_mm - stick_out_mm
    parked_mm = np.array([x, y, top_tip_mm - share * envelope.travel_z_mm])
    assert strikes(envelope, base_mm, reach, stick_out_mm, text, parked_mm) in ([], ["parked"])


def make_fit() -> tuple[Envelope, Reach, str]:
    """A finish of a block with a clamp at its left, on a mill that just has room for it."""
    text = text_of("finish", 12.0, 15.0, raised=False)
    clamp = Clamp(x_mm=-30.0, y_mm=0.0, width_mm=20.0, depth_mm=6.0, height_mm=10.0)
    envelope = Envelope(
        width_mm=WIDTH, height_mm=HEIGHT, margin_mm=MARGIN, thickness_mm=15.0, safe_z_mm=12.0, travel_z_mm=60.0,
        clamps=(clamp,), bed_to_collet_mm=80.0, nose_mm=((12.0, 20.0), (20.0, 50.0)),
    )  # fmt: skip
    return envelope, reach_of("finish", text), text


@pytest.mark.parametrize(
    ("change", "met"),
    [
        ("short tool", "nose"),
        ("high base", "travel"),
        ("low base", "travel"),
        ("near clamp", "clamp"),
        ("high clamp", "clamp"),
        ("table", "table"),
        ("gantry", "gantry"),
    ],
)
def test_what_the_rules_refuse_does_meet_something(change: str, met: str) -> None:
    """Each rule broken: the same motions strike."""
    envelope, reach, text = make_fit()
    stick_out_mm = envelope.least_stick_out_mm(reach)
    (least_mm, most_mm), base_mm = envelope.base_range_mm([reach]), 20.0
    parked_mm = np.array([40.0, 40.0, 11.0])
    assert strikes(envelope, base_mm, reach, stick_out_mm, text, parked_mm) == []
    if change == "short tool":
        stick_out_mm = -reach.lowest_mm - 0.1
    elif change == "high base":
        base_mm = most_mm + 0.1
    elif change == "low base":
        envelope = replace(envelope, travel_z_mm=20.0)
        base_mm = envelope.base_range_mm([reach])[0] - 0.1
    elif change == "near clamp":
        envelope = replace(envelope, clamps=(replace(envelope.clamps[0], x_mm=-21.5),))
        assert list(envelope.find_struck(reach))
    elif change == "high clamp":
        envelope = replace(envelope, clamps=(replace(envelope.clamps[0], x_mm=-20, width_mm=40, height_mm=12.5),))
    elif change == "gantry":
        envelope = replace(envelope, gantry_mm=15.0 + 20.0 + 10.0 - 0.1)
        assert envelope.base_range_mm([reach])[1] < 20.0
    else:
        text = text_of("cut-out", 12.0, 15.0, raised=False)
        envelope, base_mm = replace(envelope, clamps=(), through_mm=CUT_OUT.through_mm, bed_to_collet_mm=60.0), 0.4
        reach = reach_of("cut-out", text)
        stick_out_mm = envelope.least_stick_out_mm(reach)
        assert envelope.base_range_mm([reach])[0] >= 0.5
    assert met in strikes(envelope, base_mm, reach, stick_out_mm, text, parked_mm)
    assert least_mm <= 20.0 <= most_mm


def test_plan_check_and_sheet_ask_for_the_same_stick_out() -> None:
    """Deepest cut, what stands under the nose, and a clearance; never so little that the flutes are clamped."""
    envelope, reach, _ = make_fit()
    assert envelope.least_stick_out_mm(reach) == pytest.approx(2.0 - reach.lowest_mm + 10.0)
    far = replace(envelope, clamps=(replace(envelope.clamps[0], x_mm=-100.0),))
    assert far.least_stick_out_mm(reach) == pytest.approx(max(2.0 - reach.lowest_mm, 4.0 * reach.radius_mm))
    assert far.least_stick_out_mm(replace(reach, flute_length_mm=30.0)) == 30.0
