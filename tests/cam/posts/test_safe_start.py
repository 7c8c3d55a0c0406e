"""From wherever a head is parked, a program first goes up, then across, then down; and it ends where it first went."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cam.around.paths import trace_paths
from cam.moves import Path, cut, rapid
from cam.passes import Stock
from cam.posts.dialects import POSTS
from cam.posts.post import ProgramSetup, RmlPost
from cam.posts.writers import create_writer
from machines.driver import Triple
from machines.simulated.interpreter import SimulatedInterpreter
from tests.machines.roland.simulated_blocks import BlockInterpreter, SimulatedAxes

SAFE_Z = 5.0
TRAVEL_MM = (300.0, 300.0, 80.0)
STOCK = Stock(width_mm=20, height_mm=10, thickness_mm=10, margin_mm=2)
WAY = [rapid((3, 2, SAFE_Z), (3, 2, 1)), cut([(3, 2, -0.5), (9, 8, -1)], 600), rapid((9, 8, SAFE_Z))]
TRACE = trace_paths(STOCK, (), safe_z_mm=SAFE_Z, feed_mm_per_min=1200)
_OWN_WORDS = ((rb"^(%|O\d+|G64.*|G4.*)$", b""), (rb"^G16H0", b"G53"), (rb"^G15H1", b"G54"), (rb"\(.*\)", b""))

PARKED = st.tuples(*(st.floats(0, most) for most in TRAVEL_MM))
ZERO = st.tuples(st.floats(30, 200), st.floats(30, 200), st.floats(20, TRAVEL_MM[2] - SAFE_Z))


def program(dialect: str, setup: ProgramSetup, trace: tuple[Path, ...]) -> bytes:
    writer = create_writer(POSTS[dialect])
    text = writer.start((), rpm=12000, safe_z_mm=SAFE_Z, setup=setup, trace=trace)
    text += b"".join(piece for path in WAY for piece in writer.write(path))
    return text + writer.end(safe_z_mm=SAFE_Z, setup=setup)


def run(dialect: str, text: bytes, parked_mm: Triple, zero_mm: Triple) -> list[Triple]:
    """Return the machine places that a simulated control of the dialect goes to, one after the other."""
    lines = [line.rstrip(b"\r") for line in text.split(b"\n")]
    return (_run_roland if dialect.startswith(("roland", "rml")) else _run_words)(lines, parked_mm, zero_mm)


def _run_words(lines: list[bytes], parked_mm: Triple, zero_mm: Triple) -> list[Triple]:
    control, places = SimulatedInterpreter(position=parked_mm), []
    control.stored["G54"] = zero_mm
    for line in lines:
        for own, common in _OWN_WORDS:
            line = re.sub(own, common, line)
        action = control.read(line)
        control.modal, control.feed, control.spindle_rpm = action.modal, action.feed, action.spindle_rpm
        if action.move is not None:
            control.position = action.move.target
            places.append(control.position)
    return places


def _run_roland(lines: list[bytes], parked_mm: Triple, zero_mm: Triple) -> list[Triple]:
    """The top of this mill is Z0; what goes beyond it in NC code is flattened from then on."""
    axes, places = SimulatedAxes(machine_mm=parked_mm), []
    rml = lines[0].startswith(b";")
    control = BlockInterpreter(axes, {1: zero_mm, 3: zero_mm}, language="rml" if rml else "nc")
    for line in lines:
        assert not control.is_refused(line), line
        control.begin(line, 0.0)
        while (move := axes.finish()) is not None:
            places.append(move.end_mm)
            control.go_on(0.0)
    assert not axes.flattened
    return places


def require_up_first(parked_mm: Triple, places: list[Triple], first_mm: tuple[float, float], clear_mm: float) -> None:
    """Up, across no lower than clear_mm, until over its first place; then straight down."""
    at = parked_mm
    for number, place in enumerate(places):
        if at[:2] == pytest.approx(first_mm, abs=0.006):
            assert place[:2] == at[:2] or place[2] >= at[2], "the way down is straight"
            return
        assert place[2] >= at[2] - 1e-9, f"move {number} goes down from {at} to {place}"
        assert place[:2] == at[:2] or at[2] >= clear_mm - 1e-9, f"move {number} goes across too low, at {at}"
        at = place
    pytest.fail("never over its first place")


def shift(place: Triple, by_mm: float) -> Triple:
    return (place[0], place[1], place[2] + by_mm)


@pytest.mark.parametrize("dialect", sorted(POSTS))
@settings(max_examples=60, deadline=None)
@given(parked=PARKED, zero=ZERO, traced=st.booleans(), origin=st.sampled_from([0.0, -TRAVEL_MM[2]]))
def test_a_program_first_goes_up_from_any_parked_position(dialect, parked, zero, traced, origin):
    """Clamps as high as the safe height. `origin`: machine Z counts from the bottom of the travel, or from its top."""
    if dialect.startswith(("roland", "rml")):
        origin = -TRAVEL_MM[2]
    top_mm = TRAVEL_MM[2] + origin
    parked, zero = shift(parked, origin), shift(zero, origin)
    setup, trace = ProgramSetup(top_z_mm=top_mm), TRACE if traced else ()
    places = run(dialect, program(dialect, setup, trace), parked, zero)
    x, y, _ = (trace or WAY)[0].points_mm[0]
    require_up_first(parked, places, (zero[0] + x, zero[1] + y), zero[2] + SAFE_Z)
    assert places[-1][2] == top_mm, "parked at its top"
    assert places[-1][:2] == places[-2][:2]


@pytest.mark.parametrize("dialect", [name for name, post in POSTS.items() if not isinstance(post, RmlPost)])
@settings(max_examples=30, deadline=None)
@given(parked=PARKED, zero=ZERO, traced=st.booleans())
def test_without_a_known_top_it_goes_up_from_below_the_safe_height(dialect, parked, zero, traced):
    """From above that, `machines.mill` starts it over the block alone."""
    parked, zero = shift(parked, -TRAVEL_MM[2]), shift(zero, -TRAVEL_MM[2])
    parked = (parked[0], parked[1], min(parked[2], zero[2] + SAFE_Z))
    trace = TRACE if traced else ()
    places = run(dialect, program(dialect, ProgramSetup(), trace), parked, zero)
    x, y, _ = (trace or WAY)[0].points_mm[0]
    require_up_first(parked, places, (zero[0] + x, zero[1] + y), zero[2] + SAFE_Z)
