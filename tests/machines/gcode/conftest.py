"""Random programs in the full language, mostly valid, and what reads them."""

from __future__ import annotations

from hypothesis import strategies as st

_NUMBERS = st.one_of(
    st.integers(-30, 30).map(str),
    st.floats(-60, 60, allow_nan=False).map(lambda v: f"{v:.4f}"),
    st.sampled_from(["0", "-0.", ".5", "+1.250", "-.25"]),
)
_AXES = st.lists(st.tuples(st.sampled_from("XYZ"), _NUMBERS), min_size=1, max_size=3, unique_by=lambda w: w[0]).map(
    lambda words: "".join(letter + number for letter, number in words)
)
_MOTION = st.sampled_from(["", "G0", "G1", "G01", "G00", ""])
_FEED = st.sampled_from(["", "", "F600", "F12.5", "f90"])
_STRAIGHT = st.builds(lambda motion, axes, feed: motion + axes + feed, _MOTION, _AXES, _FEED)
_HALF_ARC = st.builds(
    lambda word, letter, x, r: f"{word}{letter}{x}R{r}F100",
    *(st.sampled_from(["G2", "G3"]), st.sampled_from("XYZ"), _NUMBERS, st.sampled_from(["40", "-50", "70.5"])),
)
_CIRCLE = st.builds(
    lambda word, axis, i, j, k: f"{word} {axis} I{i} J{j} K{k} F250",
    *(st.sampled_from(["G2", "G3"]), st.sampled_from(["G91 X0 Y0 Z0", "G91 X0Y0Z1.5"]), _NUMBERS, _NUMBERS, _NUMBERS),
)
_MODES = st.sampled_from(
    ["G20", "G21", "G90", "G91", "G17", "G18", "G19", "G94", "G54", "G40", "G49", "G61", "G91.1", "G21G90G94G17G54",
     "M3 S9000", "m4s100", "M5", "M8", "M7", "M9", "S1234", "T3", "N12 G21", "F300", "N7", "", "(note)", "; note",
     "G4 P0.5", "M0", "G92 X0 Y1", "G10 L20 P1 X0 Y0 Z0", "G10 L2 P2 X5", "G10L20P0Z1", "G43.1 Z12.5", "G28.1", "G0",
     "G1 F90", "G0 Z5", "G0 X0 Y0 Z5", "G90 G21 G0 X0 Y0 Z5", "G1 X1 F2 (a) Y2", "G0 X1 0", " g 1 x 1 f 5 ",
     "G90 G0 X0 Y0 Z0"]
)  # fmt: skip
# Lines after which the place of an axis is not known, or a later line may well be refused.
_RISKY = st.sampled_from(
    ["G93", "G93 G1 X1 F3", "G55", "G80", "G28", "G30 Z0", "G91 G28 Z0", "G53 G0 Z-1", "G92.1", "G10 L2 P1 X5",
     "G38.2 Z-5 F50", "M2", "M30"]
)  # fmt: skip
WRONG_LINES = (
    ["G0 G1 X1", "X1 X2", "M6", "G81 X1 Z-1 R1", "G41", "%", "$H", "/X1", "G1 X", "X--1", "G0 X1(", "G5", "M98", "F0",
     "F-1", "S-1", "G4", "G4 P1 X1", "G2 X1", "G2 X1 R0.1", "G3 X9 Y0 R1", "G2 X2 I9 J9 F1", "P5", "G0 X1 P5", "G92",
     "G10 X1", "G10 L3 P1 X1", "G43.1 X1", "G53 G2 X1", "N1.5", "T256", "G1.5 X1", "G0 G92 X1",
     "G0X1P5", "G1X1I2", "X1L2", "X1T300", "X1N-1", "X1e3", "Q1",
     "G0X999999", "O1", "G43 H1", "\u00e4", "G59.1", "G90.1"]
)  # fmt: skip
_WRONG = st.sampled_from(WRONG_LINES)


def programs(wrong: bool = True) -> st.SearchStrategy[bytes]:
    """Whole programs, most of them without a fault; with `wrong`, some have a line that must be refused."""
    usual = st.one_of(_STRAIGHT, _STRAIGHT, _STRAIGHT, _MODES, _MODES, _CIRCLE, _HALF_ARC)
    rare = st.one_of(_RISKY, _WRONG) if wrong else _RISKY
    line = st.integers(0, 19).flatmap(lambda dice: rare if dice == 0 else usual)
    ends = st.sampled_from(["\n", "\r\n"])
    start = st.sampled_from(["", "G21 G90\nG0 X0 Y0 Z5\nF100\n", "G21 G90\nG0 X0 Y0 Z5\nF100\n"])
    return st.builds(
        lambda head, lines, end, last: (head + end.join(lines) + last).encode("utf-8"),
        *(start, st.lists(line, max_size=14), ends, st.sampled_from(["", "\n"])),
    )
