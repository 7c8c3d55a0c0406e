"""Whatever is sent and pressed whenever: simulated time goes on, and a model caught in a loop says so."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.simulated import FLUIDNC, GRBL_11, GRBL_11_ECHO, GRBLHAL, Faults, SimulatedMill
from machines.simulated.mill import BUTTONS

SAID = [
    *(b"G1X%dF%d\n" % (x, f) for x, f in ((1, 10), (-1, 5000), (0, 600))),
    *(b"G1X%.6f\n" % x for x in (0.000001, 0.004, 1e-9)),
    *(b"G2X0Y0I5\n", b"G3X0I0.001\n", b"G2X1R0.5\n", b"G4P0\n", b"G4P0.5\n", b"M0\n", b"M3S100\n", b"M5\n", b"M2\n"),
    *(b"G93\n", b"G94\n", b"G1X3F0.0001\n", b"G91\n", b"G90\n", b"G10L20P0X0\n", b"G38.2Z-9F50\n", b"G92X5\n"),
    *(b"$H\n", b"$X\n", b"$C\n", b"$J=G91X2F500\n", b"$SLP\n", b"$120=0.001\n", b"$110=1\n", b"$12=0\n", b"$11=0\n"),
    *(b"$N0=G1X1F100\n", b"$RST=*\n", b"$22=1\n", b"$20=1\n"),
    *(bytes([byte]) for byte in (*b"?!~\x18", *range(0x84, 0x86), *range(0x90, 0xA2))),
]
STEPS = st.tuples(
    st.one_of(st.sampled_from(SAID), st.sampled_from(BUTTONS), st.binary(max_size=6)),
    st.sampled_from([0.0, 0.0, 0.001, 0.02, 0.4, 30.0]),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(STEPS, max_size=60), st.sampled_from([GRBL_11, GRBL_11_ECHO, GRBLHAL, FLUIDNC]), st.booleans())
def test_simulated_time_always_goes_on(steps, traits, paced) -> None:
    mill = SimulatedMill(replace(traits, lines_per_s=None) if not paced else traits)
    mill.use_wire(1 / 11520 if paced else 0.0)
    mill.advance(1.0)
    for what, seconds in steps:
        if isinstance(what, str):
            mill.press(what)
        else:
            mill.receive(what)
        mill.advance(mill.now_s + seconds, until_output=seconds == 0.4)
        mill.output()
    end_s = mill.now_s + 100.0
    mill.advance(end_s)
    assert mill.now_s == end_s


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12))
def test_faults_by_the_dozen_do_not_stop_time(seed, count) -> None:
    mill = SimulatedMill(GRBL_11, Faults.by_seed(seed, count=count, lines=(1, 40)), seed=seed)
    mill.use_wire(1 / 11520)
    mill.advance(1.0)
    for k in range(60):
        mill.receive(b"G1X%d.5F1000\n?" % (k % 3))
        mill.advance(mill.now_s + 0.1, until_output=True)
        mill.output()
    mill.advance(mill.now_s + 500.0)


def test_a_model_caught_in_a_loop_says_so() -> None:
    mill = SimulatedMill(GRBL_11)

    def again() -> None:
        mill.call_at(mill.now_s, again)

    mill.call_at(2.0, again)
    with pytest.raises(AssertionError, match=r"stands still at 2\.0"):
        mill.advance(3.0)
