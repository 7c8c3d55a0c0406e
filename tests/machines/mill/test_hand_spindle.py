"""The spindle by hand turns by an order alone, and only as long as its giver has control of a mill nobody stopped."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from machines.driver import CheckMode, Jog, MillState, ProbeZ, SendBlock, SetZero
from machines.errors import MachineError, NotAllowedError
from machines.mill.orders import LEASE_S, Caller, OrderRefusedError, Stop
from machines.runs import RunState
from tests.machines.shop import LINES, YES, YES_ALL, Shop


class Manned(Shop):
    """A mill of which Ada has control."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, LINES)
        self.take_control()

    def take_control(self) -> None:
        self.mill.orders._clock = lambda: self.bench.sim.now_s
        self.secret, _, _ = self.mill.orders.take_lease("Ada", "p", take_over=True)

    def ask(self) -> str:
        return str(self.mill.orders.issue_grant(self.secret).word)

    def give(self, act: Callable[[Any], object], grant: str | None = None) -> None:
        caller = Caller(name="Ada", grant=self.ask() if grant is None else grant)
        self.mill.carry_out("order", act, caller, needs_lease=True)
        self.pass_s(1.0)

    def switch(self, rpm: float | None, grant: str | None = None) -> None:
        self.give(lambda mill: mill.switch_spindle(rpm), grant)

    def stop(self, stop: Stop) -> None:
        self.mill.orders.count_stop(stop)
        self.mill.carry_out_stop(stop, Caller())

    def release(self) -> None:
        self.mill.orders.release_lease(self.secret)

    def jog(self) -> None:
        self.give(lambda mill: mill.command(Jog((40.0, 0.0, 0.0), 100.0)))

    def check(self) -> None:
        self.mill.command(CheckMode(True))
        self.pass_s(1.0)

    @property
    def turns(self) -> bool:
        return bool(self.bench.sim.firmware.spindle_on())

    def until_off(self) -> None:
        self.bench.until(lambda: not self.turns, patience_s=20.0)


@pytest.fixture
def shop(tmp_path: Path) -> Manned:
    return Manned(tmp_path)


ENDS: dict[str, Callable[[Manned], object]] = {
    "hold": lambda shop: shop.stop(Stop.HOLD),
    "abort": lambda shop: shop.stop(Stop.ABORT),
    "given back": lambda shop: shop.release(),
    "taken over": lambda shop: shop.mill.orders.take_lease("Bob", "q", take_over=True),
    "lapsed": lambda shop: shop.pass_s(LEASE_S + 1.0),
    "given back in a jog": lambda shop: (shop.jog(), shop.release()),
    "held in a jog": lambda shop: (shop.jog(), shop.stop(Stop.HOLD)),
    "given back in check mode": lambda shop: (shop.check(), shop.release()),
    "held by a line": lambda shop: (
        shop.mill.command(SendBlock("G1 X50 F100")),
        shop.pass_s(1.0),
        shop.stop(Stop.HOLD),
    ),
    "the owner ends": lambda shop: shop.mill.close(),
    "off": lambda shop: shop.switch(None),
}


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("on", ["order", "line"])
def test_it_goes_off_when_its_giver_is_not_in_control_any_more(shop: Manned, end: str, on: str) -> None:
    if on == "order":
        shop.switch(9000.0)
    else:
        shop.give(lambda mill: mill.command(SendBlock("M03 S9000")))
    assert shop.turns and shop.bench.sim.firmware.spindle_rpm == 9000.0
    shop.pass_s(LEASE_S - 10.0)
    assert shop.turns
    ENDS[end](shop)
    if end == "the owner ends":
        assert not shop.turns
        return
    shop.until_off()
    shop.pass_s(5.0)
    assert shop.mill.status.state is MillState.IDLE
    shop.take_control()
    shop.id = shop.mill.park(shop.facts, shop.path, "part").id
    shop.mill.start(shop.id, YES)  # nothing is left of it
    shop.until(RunState.FINISHED)


def test_the_end_of_a_jog_leaves_it_on(shop: Manned) -> None:
    """An edge finder turns while the mill is jogged step by step."""
    shop.switch(1500.0)
    shop.jog()
    shop.stop(Stop.JOG_CANCEL)
    shop.pass_s(5.0)
    assert shop.turns and shop.mill.status.state is MillState.IDLE


def test_a_link_that_was_lost_comes_back_with_the_spindle_off(shop: Manned) -> None:
    shop.switch(9000.0)
    shop.bench.sim.unplug()
    shop.pass_s(3.0)
    assert shop.turns
    shop.bench.sim.replug()
    shop.until_off()
    shop.pass_s(2.0)
    shop.switch(9000.0)
    assert shop.turns


def test_a_grant_switches_it_on_once(shop: Manned) -> None:
    grant = shop.ask()
    shop.switch(9000.0, grant)
    shop.switch(None)
    assert not shop.turns
    with pytest.raises(OrderRefusedError):
        shop.switch(9000.0, grant)
    shop.pass_s(5.0)
    assert not shop.turns


def test_a_new_owner_never_switches_it_on(shop: Manned) -> None:
    grant = shop.ask()
    shop.replace_owner(MillState.IDLE)
    with pytest.raises(OrderRefusedError):
        shop.switch(9000.0, grant)
    assert not shop.turns


@pytest.mark.parametrize(
    ("before", "rpm", "words"),
    [
        (lambda shop: None, 500.0, "this mill turns at 1000 to 24000"),
        (lambda shop: None, 24001.0, "this mill turns at 1000 to 24000"),
        (lambda shop: setattr(shop.mill._spindle, "rpm", None), 9000.0, "not switched from here"),
        (lambda shop: setattr(shop.mill._spindle, "rpm", (0.0, 9.0)), 0.0, "this mill turns at 0 to 9"),
        (lambda shop: shop.started(), 9000.0, "the program has the spindle"),
        (lambda shop: shop.started(), None, "the program has the spindle"),
        (lambda shop: shop.started().held(), 9000.0, "the program has the spindle"),
        (lambda shop: shop.release(), 9000.0, "control"),
        (lambda shop: shop.bench.command_done(ProbeZ(depth_mm=1.0)), 9000.0, "the mill is alarm"),
        (lambda shop: shop.bench.command_done(SendBlock("$32=1")), 9000.0, "laser mode"),
        (lambda shop: shop.check(), 9000.0, "the mill is check"),
    ],
)
def test_it_is_refused(shop: Manned, before: Callable[[Manned], object], rpm: float | None, words: str) -> None:
    before(shop)
    turned = shop.turns
    with pytest.raises(MachineError, match=words):
        shop.switch(rpm)
    shop.pass_s(1.0)
    assert shop.turns is turned


@pytest.mark.parametrize(
    "order",
    [
        lambda mill: mill.command(ProbeZ(depth_mm=10.0)),
        lambda mill: mill.go_to_zero("XYZ", 500.0),
        lambda mill: mill.start(next(iter(mill.runs)).id, YES),
    ],
)
def test_while_it_may_turn_nothing_is_probed_and_no_program_starts(
    shop: Manned, order: Callable[[Any], object]
) -> None:
    shop.bench.command_done(SetZero("XYZ"))
    shop.switch(9000.0)
    with pytest.raises(NotAllowedError, match=r"spindle (was switched on by hand; switch it off first|must be off)"):
        shop.give(order)


def test_nothing_recovers_while_it_may_turn(shop: Manned) -> None:
    shop.started().aborted()
    shop.switch(9000.0)
    with pytest.raises(NotAllowedError, match="switch it off first"):
        shop.mill.recover(shop.id, YES_ALL)


STEPS: dict[str, Callable[[Manned], object]] = {
    **{end: act for end, act in ENDS.items() if end not in ("the owner ends", "lapsed")},
    "on": lambda shop: shop.switch(9000.0),
    "line": lambda shop: shop.give(lambda mill: mill.command(SendBlock("M3 S9000"))),
    "jog": lambda shop: shop.jog(),
    "end of jog": lambda shop: shop.stop(Stop.JOG_CANCEL),
    "take": lambda shop: shop.take_control(),
    "start": lambda shop: shop.mill.start(shop.id, YES),
    "resume": lambda shop: shop.mill.resume(),
    "new owner": lambda shop: shop.replace_owner(MillState.IDLE, MillState.HELD, MillState.ALARM),
    "wait": lambda shop: shop.pass_s(3.0),
}


@settings(max_examples=30, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(steps=st.lists(st.sampled_from(sorted(STEPS)), min_size=2, max_size=8))
def test_outside_a_program_it_turns_only_under_its_givers_control(steps: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        shop = Manned(Path(folder))
        for step in ["on", *steps]:
            with contextlib.suppress(MachineError):
                STEPS[step](shop)
            if step == "new owner":
                return  # nobody's any more; that no new owner switches it on has a test of its own
            shop.pass_s(4.0)
            order, live = shop.mill._spindle._order, shop.mill._runs.live
            if shop.turns and live is None:
                assert order is not None and order.has_control, f"{step} of {steps}"
