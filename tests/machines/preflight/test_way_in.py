"""What is judged safe from anywhere is safe from every place; what is not has a place from which it hits something."""

from __future__ import annotations

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from machines.preflight.preflight import Bounds
from machines.preflight.way_in import find_risk, read_from_place, read_way_in

SAFE_Z, TOP_Z = 5.0, 0.0
WORK_ZERO_Z = -40.0  # in machine coordinates
Place = tuple[float, float, float]

HEIGHT = st.sampled_from([-10.0, -1.0, 0.0, 1.0, 4.9, 5.0, 8.0, 30.0])
ACROSS = st.integers(0, 90)
BLOCK = st.one_of(
    HEIGHT.map(lambda z: f"G0 Z{z:g}"),
    ACROSS.map(lambda x: f"G0 X{x}"),
    st.tuples(ACROSS, ACROSS).map(lambda at: f"G0 X{at[0]} Y{at[1]}"),
    st.tuples(ACROSS, ACROSS, HEIGHT).map(lambda at: f"G0 X{at[0]} Y{at[1]} Z{at[2]:g}"),
    st.tuples(ACROSS, HEIGHT).map(lambda at: f"G1 X{at[0]} Z{at[1]:g} F100"),
    st.sampled_from([-60.0, -20.0, -5.0, -1.0]).map(lambda z: f"G53 G0 Z{z:g}"),
    st.just("M3 S1000"),
)
PROGRAM = st.tuples(
    st.sampled_from([[], ["G0 Z8"], ["G53 G0 Z-1"], ["G53 G0 Z-1", "G0 X3 Y4"]]),
    st.lists(BLOCK, min_size=1, max_size=6),
).map(lambda parts: parts[0] + parts[1])
PARKED = st.tuples(st.floats(-50, 150), st.floats(-50, 150), st.floats(-9, 40)).map(
    lambda place: tuple(round(value, 1) for value in place)  # moves within what positions are reported to are none
)


def lines_of(program: list[str]) -> list[tuple[int, bytes]]:
    return [(number, line.encode()) for number, line in enumerate(["G21 G90 G54", *program], 1)]


def hits(program: list[str], parked: Place) -> bool:
    """Whether the tool, from its work place, goes across lower than the safe height before X, Y and Z are given."""
    at, given_axes = dict(zip("XYZ", parked, strict=True)), set[str]()
    for block in program:
        if not block.startswith("G"):
            continue
        before, machine = dict(at), block.startswith("G53")
        for word in block.split():
            if word[0] in "XYZ":
                at[word[0]] = float(word[1:]) - WORK_ZERO_Z if machine else float(word[1:])
                given_axes |= set() if machine else {word[0]}
        moves_across = (at["X"], at["Y"]) != (before["X"], before["Y"])
        if moves_across and min(at["Z"], before["Z"]) < SAFE_Z:
            return True
        if len(given_axes) == 3:
            return False
    return False


@settings(max_examples=500)
@given(program=PROGRAM, parked=PARKED)
def test_what_is_safe_from_anywhere_hits_nothing_from_any_place(program: list[str], parked: Place) -> None:
    way = read_way_in(lines_of(program), dialect="grbl")
    risk = find_risk(way.motions, safe_z_mm=SAFE_Z, top_z_mm=TOP_Z)
    event("risky" if risk else "safe")
    assert risk is not None or not hits(program, parked)


@settings(max_examples=500)
@given(program=PROGRAM, parked=PARKED)
def test_what_hits_something_from_a_place_that_is_known_is_seen(program: list[str], parked: Place) -> None:
    """Beside what is milled; rapids alone, as a person is asked about cuts."""
    program = [block for block in program if not block.startswith("G1")]
    if not hits(program, parked):
        return
    way = read_from_place(lines_of(program), dialect="grbl", wcs="G54", place_mm=parked)
    nowhere = Bounds((500.0, 500.0, 0.0), (501.0, 501.0, 5.0))
    assert find_risk(way.motions, safe_z_mm=SAFE_Z, top_z_mm=TOP_Z, over=nowhere) is not None


@pytest.mark.parametrize(
    ("parked", "risky"),
    [
        ((0.0, 0.0, 0.0), True),  # across at the height of the stock's top, past whatever clamps it
        ((0.0, 0.0, 30.0), True),  # down on a slant, to a millimetre above the block
        ((10.0, 10.0, 30.0), False),  # straight down, over what is milled
        ((15.0, 12.0, 2.0), False),  # across over what is milled
        ((15.0, 12.0, -3.0), True),  # in a groove of the pass before
    ],
)
def test_a_slanting_first_rapid_is_safe_from_few_places(parked: Place, risky: bool) -> None:
    way = read_from_place(lines_of(["G0 X10 Y10 Z1"]), dialect="grbl", wcs="G54", place_mm=parked)
    box = Bounds((10.0, 10.0, -1.0), (20.0, 20.0, 5.0))
    assert (find_risk(way.motions, safe_z_mm=SAFE_Z, top_z_mm=None, over=box) is not None) is risky
