"""What a watcher reads of orders that somebody else has given: with axis and value, and never more than was done."""

from __future__ import annotations

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
    ProbeZ,
    ReadSettings,
    Reset,
    SendBlock,
    SetZero,
    TrustPosition,
    Unlock,
)
from machines.mill.command_words import command_words
from tests.machines.shop import Shop


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
        (Override("spindle", 90), "Spindle at 90 %"),
        (Override("rapid", 25), "Rapids at 25 %"),
        (SendBlock("M3 S12000"), "Line M3 S12000"),
        (CheckMode(on=True), "Check mode on"),
        (CheckMode(on=False), "Check mode off"),
        (Home(), "Home"),
        (Unlock(), "Unlock"),
        (Reset(), "Reset"),
        (JogCancel(), "End jog"),
        (TrustPosition(), "Position taken as right"),
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
