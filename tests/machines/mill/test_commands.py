"""Commands in words: with axis and value, never more than was done; and what a line from the console would change."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from machines.driver import (
    CheckMode,
    Command,
    CommandDone,
    Home,
    Jog,
    JogCancel,
    MillState,
    Override,
    ProbeCorner,
    ProbeZ,
    ReadSettings,
    Reset,
    SendBlock,
    SetZero,
    TrustPosition,
    Unlock,
)
from machines.mill.commands import EFFECTS, command_words, describe_effect
from machines.simulated import CornerPlate
from tests.machines.shop import Shop

# One line for each row, in the table's order, spelled in one of the ways that controllers take.
LINES = (
    ("$RST=*", "factory values"),
    ("$N0=G0X0", "by itself"),
    ("$1=255", "driven and held"),
    ("$5=1", "signals"),
    ("$10=3", "reports"),
    ("$13=1", "inches"),
    ("$20=0", "soft limits off"),
    ("$021 = 0.0", "limit switches off"),
    ("$22=0", "homing off"),
    ("$23=3", "homes"),
    ("$30=1000", "spindle speed"),
    ("$32=1", "laser mode on"),
    ("$100=250", "steps per mm"),
    ("$110=5000", "how fast"),
    ("$130=900", "travel"),
    ("$f=/part.nc", "a file"),
    ("$/axes/x/max_travel_mm=900", "for good"),
    ("$$", ""),
    ("$MD", "unknown command"),
    ("[ESP220]/part.nc", "files and network"),
    ("#5221=1", "parameter"),
    ("g10 l20 p1 x0", "work zero or a tool's length"),
    ("G1 F100 G092.10", "shifts the work zero"),
    ("G(to the second vice)55", "another work coordinate system"),
    ("G43.1 Z-3", "length of the tool"),
    ("G51 X2", "scales"),
    ("G28.1", "stores this place"),
    ("N5 G20 G0 X1", "inches"),
)

CORNER = ProbeCorner(
    depth_mm=20.0, plate_mm=10.0, wall_x_mm=6.0, wall_y_mm=6.0, cutter_radius_mm=1.5, margin_mm=8.0
)  # fmt: skip


def words(command: Command, failure: str = "", **answer: Any) -> str:
    return command_words(CommandDone(command, failure, answer), from_mm=None, at_mm=None)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (Jog((10.0, 0.0, -0.5)), "Jog X +10 mm, Z -0.5 mm"),
        (Jog((0.0, 0.0, 7.3000000000000007)), "Jog Z +7.3 mm"),
        (SetZero("XYZ"), "X, Y and Z = 0 here"),
        (SetZero("XY"), "X and Y = 0 here"),
        (SetZero("Z"), "Z = 0 here"),
        (ProbeZ(depth_mm=10.0, plate_mm=5.2), "Probe Z down by at most 10 mm, plate 5.2 mm"),
        (CORNER, "Probe the corner, cutter of radius 1.5 mm, plate 10 mm"),
        (Override("spindle", 90), "Spindle at 90 %"),
        (Override("rapid", 25), "Rapids at 25 %"),
        (SendBlock("M3 S12000"), "Line M3 S12000"),
        (CheckMode(on=True), "Check mode on"),
        (CheckMode(on=False), "Check mode off"),
        (Home(), "Home"),
        (Unlock(), "Unlock"),
        (Reset(), "Reset"),
        (JogCancel(), "End jog"),
        (TrustPosition(), "Position trusted"),
        (ReadSettings(), "Read settings"),
    ],
)
def test_every_order_is_said_with_what_it_was_about(command: Command, said: str) -> None:
    assert words(command) == f"{said}: done"
    assert words(command, "it was refused") == f"{said}: it was refused"


def test_a_probe_says_where_it_touched() -> None:
    assert words(ProbeZ(depth_mm=10.0), contact_machine_mm=[-5.0, -5.0, -25.003]).endswith(
        ": touched at machine Z -25.003 mm"
    )
    said = words(CORNER, contact_machine_mm=[-8.5, -10.5, -5.0])
    assert said.endswith(": touched at machine X -8.500, Y -10.500, Z -5.000 mm")


def test_a_corner_that_was_probed_is_a_zero_of_all_axes_and_a_touch_off(shop: Shop) -> None:
    shop.bench.sim.firmware.traits = replace(
        shop.bench.sim.firmware.traits,
        corner_plate=CornerPlate(left_mm=-9.0, front_mm=-9.0, tool_radius_mm=CORNER.cutter_radius_mm),
    )
    shop.bench.command_done(CORNER)
    assert (shop.mill.snapshot.zeroed, shop.mill.snapshot.zeroed_anew) == ("XYZ", "XYZ")


def test_a_jog_that_was_ended_is_not_said_to_have_gone_all_the_way(shop: Shop) -> None:
    bench = shop.bench
    bench.command_done(Jog((-10.0, 0.0, 0.0), 2000.0))
    bench.mill.command(Jog((0.0, 20.0, 0.0), 500.0))
    bench.until_state(MillState.JOG)
    shop.pass_s(0.5)
    bench.command_done(JogCancel())
    bench.until_state(MillState.IDLE)
    shop.pass_s(1.0)
    whole, cancel, part = [one.words for one in bench.mill.snapshot.events if one.kind == "command"][-3:]
    gone_mm = bench.mill.status.machine_mm[1]
    assert whole == "Jog X -10 mm: done"
    assert cancel == "End jog: done"
    assert 0 < gone_mm < 19
    assert part == f"Jog Y +20 mm: ended after Y {gone_mm:+g} mm"
    bench.command_done(SetZero("XY"))
    said = bench.mill.snapshot.events[-1].words
    assert said == f"X and Y = 0 here: done, at machine X -10.000, Y {gone_mm:.3f} mm"


@pytest.mark.parametrize("row", range(len(EFFECTS)))
def test_each_row_says_what_its_line_would_do(row: int) -> None:
    (line, words), effect = LINES[row], EFFECTS[row][1]
    assert describe_effect(line) == effect and words in effect
    assert len(LINES) == len(EFFECTS)


@pytest.mark.parametrize(
    "line",
    ["$N1=M3 S9000", "$21=0", "$RST=$", "$RST=#", "$ rst = *", "$130=1", "$20=1", "$N=G20", "G92", "G59.3", "$+20=0"],
)
def test_no_other_spelling_passes(line: str) -> None:
    assert describe_effect(line)


@pytest.mark.parametrize(
    "line",
    ["G0 Z5", "M3 S1000", "$#", "$G", "$I", "$N", "$", "G54", "G91 G0 X-1", "G1 X10 Y92 F100", "(G10 L20)", "G4 P1"],
)
def test_moves_and_questions_pass(line: str) -> None:
    assert describe_effect(line) == ""


def test_the_words_are_the_end_of_a_sentence() -> None:
    assert all(re.fullmatch(r"[a-z][^.]*", words.replace("25.4", "")) for _, words in EFFECTS if words)
