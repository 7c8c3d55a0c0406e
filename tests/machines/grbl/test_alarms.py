"""After every alarm a person gets back to work, and what is said of position and spindle meanwhile is true."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest

from machines.driver import (
    FaultCause,
    Faulted,
    Home,
    Jog,
    MillState,
    Notice,
    ProbeZ,
    Reset,
    Restarted,
    SendBlock,
    Stopped,
    TrustPosition,
    Unlock,
)
from machines.errors import NotAllowedError
from machines.grbl.session import GrblSession
from machines.grbl.settings import find_missing_option
from machines.simulated.faults import Fault, Faults
from machines.simulated.traits import GRBL_11, GRBLHAL, Traits
from tests.machines.grbl.bench import Bench, numbered, spiral

HOMED = replace(GRBL_11, homing=True).with_settings({20: 1, 21: 1})


def homed(traits: Traits = HOMED) -> Bench:
    bench = Bench(traits).connected()
    bench.do(Unlock() if traits.homing_alarm else Home())
    bench.until(lambda: bench.state() is MillState.IDLE)
    bench.do(SendBlock("G0X-20Y-20Z-5"))
    bench.do(SendBlock("M3S1000"))
    bench.pass_time(2.0)  # the spindle is reported now and then
    assert bench.driver.status.spindle_on
    return bench


def cut(bench: Bench, *blocks: bytes) -> None:
    bench.start(numbered([b"G21G90G94G17", *blocks, b"M2"]))
    bench.pass_time(0.5)


def limit_switch(bench: Bench) -> None:
    cut(bench, b"G1X-30F600")
    bench.mill.press("limit")


def reset_button(bench: Bench) -> None:
    cut(bench, b"G1X-30F600")
    bench.mill.press("reset")


def hold_while_homing(bench: Bench) -> None:
    bench.driver.command(Home())
    bench.pass_time(1.0)
    bench.driver.hold()


def door_while_homing(bench: Bench) -> None:
    bench.driver.command(Home())
    bench.pass_time(1.0)
    bench.mill.press("door")
    bench.mill.press("close-door")


@dataclass(frozen=True)
class Row:
    provoke: Callable[[Bench], None]
    resets: bool = False  # by us
    trusted: bool = False
    spindle_on: bool = False


ALARMS = {
    1: Row(limit_switch, resets=True),
    2: Row(lambda b: cut(b, b"G1X-30F600", b"X20"), resets=True, trusted=True),
    3: Row(reset_button),
    4: Row(lambda b: b.driver.command(ProbeZ(depth_mm=1.0)), trusted=True, spindle_on=True),
    5: Row(lambda b: b.driver.command(ProbeZ(depth_mm=1.0)), trusted=True, spindle_on=True),
    6: Row(hold_while_homing, resets=True),
    7: Row(door_while_homing),
    8: Row(lambda b: b.driver.command(Home())),
    9: Row(lambda b: b.driver.command(Home())),
    10: Row(lambda b: b.driver.command(Home())),
}


@pytest.mark.parametrize("number", ALARMS)
def test_back_to_work_after(number: int) -> None:
    row = ALARMS[number]
    failing = number if number in (8, 9, 10) else 0
    surface = 6.0 if number == 4 else None
    bench = homed(replace(HOMED, probe_surface_mm=surface, homing_alarm=failing))
    begin, epoch = len(bench.tap.written), bench.driver.status.epoch
    row.provoke(bench)
    assert bench.until(lambda: f"ALARM:{number} " in bench.driver.status.detail, 200.0)
    status = bench.driver.status
    assert status.state is MillState.ALARM
    assert status.spindle_on is row.spindle_on and bench.mill.firmware.spindle_on() is row.spindle_on
    assert (status.spindle_rpm == 0.0) is not row.spindle_on
    ready = lambda: bench.state() is MillState.ALARM and bench.driver._session.link.phase.value == "ready"  # noqa: E731
    assert bench.until(ready, 10.0), bench.driver.status
    written = bench.written(begin)
    assert (b"\x18" in written) is row.resets
    if number not in (4, 5):
        assert bench.until(lambda: bench.driver.status.epoch > epoch, 5.0)
        assert bench.until(ready, 10.0), bench.driver.status
    assert bench.driver.status.position_trusted is (row.trusted and not failing)
    assert f"ALARM:{number} " in bench.driver.status.detail  # why it is locked, until it is no more
    assert not bench.do(Unlock()).failure
    assert bench.until(lambda: bench.state() is MillState.IDLE, 3.0)
    assert not bench.driver.status.detail
    assert not bench.do(Jog((0.0, 0.0, 0.5), 600.0)).failure


@pytest.mark.parametrize(
    "traits", [HOMED, replace(GRBLHAL, homing=True).with_settings({20: 1, 21: 1})], ids=["1.1", "hal"]
)
@pytest.mark.parametrize("fault", [None, "lose-reply", "drop"])
def test_a_critical_alarm_is_left_though_message_or_reset_are_lost(traits: Traits, fault: str | None) -> None:
    bench = homed(traits)
    cut(bench, b"G1X-30F600")
    bench.mill.press("limit")
    assert bench.until(lambda: bench.of(Faulted), 2.0)
    if fault == "lose-reply":  # the message
        bench.mill.arm(Faults((Fault(kind="lose-reply", at_s=bench.mill.now_s + 0.02),)))
    if fault == "drop":  # the first reset that would count
        bench.mill.arm(Faults((Fault(kind="drop", at_s=bench.mill.now_s + 0.51),)))
    assert bench.of(Faulted)[0].cause is FaultCause.ALARM
    assert bench.until(lambda: bench.of(Restarted)[1:] and bench.state() is MillState.ALARM, 3.0)
    assert bench.until(lambda: bench.driver._session.link.phase.value == "ready", 3.0)
    resets = bench.written().count(b"\x18")
    assert 1 <= resets <= 4


def test_a_mill_that_takes_no_reset_is_told_of_and_asked_on() -> None:
    """An emergency stop that stays pressed, or power gone: until the banner, once a second after a while."""
    bench = homed()
    cut(bench, b"G1X-30F600")
    bench.mill.press("limit")
    bench.pass_time(0.2)
    bench.mill._off = True
    bench.pass_time(30.0)
    assert any("emergency stop" in event.words for event in bench.of(Notice))
    bench.mill.power_cycle()
    assert bench.until(lambda: bench.of(Restarted)[1:], 5.0)
    assert bench.until(lambda: bench.driver._session.link.phase.value == "ready", 5.0)
    assert not bench.driver.status.position_trusted


def critical_at_opening() -> Bench:
    bench = Bench(GRBL_11.with_settings({21: 1}))
    bench.mill.advance(1.0)
    bench.mill.receive(b"G1X30F600\n")
    bench.mill.advance(1.5)
    bench.mill.press("limit")
    bench.mill.advance(5.0)
    bench.mill.output()
    bench.driver.connect()
    return bench


def test_at_opening_a_port_that_answers_nothing_gets_no_reset_but_one_may_be_sent() -> None:
    bench = critical_at_opening()
    with pytest.raises(NotAllowedError):
        bench.driver.command(Reset())  # not at once: it may only be slow
    assert bench.until(lambda: bench.driver._session.link.offers_reset, 3.0)
    assert "send a reset" in bench.driver.status.detail
    assert set(bench.written()) == set(b"?")
    bench.driver.command(Reset())
    assert bench.until(lambda: bench.state() is MillState.ALARM, 5.0)
    assert bench.until(lambda: bench.driver._session.link.phase.value == "ready", 5.0)
    assert not bench.driver.status.position_trusted


def test_a_stop_where_nothing_answers_is_written_and_ends_in_a_reset() -> None:
    bench = critical_at_opening()
    bench.driver.hold()
    assert b"!" in bench.tap.written[-1][1]
    assert bench.until(lambda: bench.driver._session.link.offers_reset, 3.0)
    bench.driver.abort()
    assert bench.until(lambda: bench.of(Stopped), 5.0)
    assert bench.until(lambda: bench.driver._session.link.phase.value == "ready", 5.0)


def test_a_silent_port_is_given_up_in_words_that_speak_of_the_reset() -> None:
    bench = critical_at_opening()
    assert bench.until(lambda: bench.state() is MillState.DISCONNECTED, 20.0)
    assert "accepts nothing but a reset" in bench.of(Faulted)[0].words
    bench = critical_at_opening()
    bench.mill._off = True
    assert bench.until(lambda: bench.driver._session.link.offers_reset, 3.0)
    bench.driver.command(Reset())
    assert bench.until(lambda: bench.state() is MillState.DISCONNECTED, 20.0)
    assert "not even" in bench.of(Faulted)[0].words


def test_a_mill_that_falls_silent_while_it_is_stopped_can_be_reset() -> None:
    """Its ALARM: line was lost: without a person's reset the session would stop for ever."""
    bench = homed()
    bench.mill.arm(Faults((Fault(kind="lose-reply", at_s=bench.mill.now_s + 0.9),)))
    cut(bench, b"G1X-30F60")
    bench.driver.abort()
    bench.mill.firmware.raise_alarm(1)
    bench.mill.output()
    bench.mill.serial.out.clear()
    bench.until(lambda: bench.driver._session.link.offers_reset, 5.0)
    if not bench.of(Restarted)[1:]:
        bench.driver.command(Reset())
    assert bench.until(lambda: bench.driver._session.link.phase.value == "ready", 5.0)


# -- where the machine stands after a banner -------------------------------------------------------------------------


def placed(traits: Traits = GRBL_11) -> Bench:
    bench = Bench(traits).connected()
    bench.do(Jog((3.0, 2.0, 1.0), 900.0))
    bench.do(TrustPosition())
    bench.pass_time(1.0)
    return bench


def restarted(bench: Bench) -> bool:
    count = len(bench.of(Restarted))
    assert bench.until(lambda: len(bench.of(Restarted)) > count, 10.0)
    trusted = bench.driver.status.position_trusted
    assert bench.until(lambda: bench.driver._session.link.phase.value == "ready", 5.0)
    assert bench.driver.status.position_trusted is trusted
    return trusted


def test_the_same_place_after_a_banner_proves_the_position() -> None:
    bench = placed()
    bench.mill.press("reset")
    assert restarted(bench)


def test_zero_proves_nothing() -> None:
    bench = placed()
    bench.mill.power_cycle()
    assert not restarted(bench)
    bench = Bench().connected()
    bench.do(TrustPosition())
    bench.mill.press("reset")
    assert not restarted(bench)


def test_a_reset_in_motion_and_from_sleep_keep_nothing() -> None:
    bench = placed()
    bench.driver.command(Jog((30.0, 0.0, 0.0), 900.0))
    bench.pass_time(1.0)
    bench.mill.press("reset")
    assert not restarted(bench)
    bench = placed()
    bench.mill.receive(b"$SLP\n")
    bench.until(lambda: bench.state() is MillState.SLEEP, 3.0)
    bench.driver.command(Reset())
    assert not restarted(bench)


def test_another_place_after_our_own_reset_is_a_lost_position() -> None:
    """The power went off in the very moment: the banner is not that of our reset."""
    bench = placed()
    bench.driver.command(Reset())
    bench.mill.power_cycle()
    assert not restarted(bench)


def test_our_own_stop_keeps_the_position_at_zero_too() -> None:
    bench = Bench().connected()
    bench.do(TrustPosition())
    bench.driver.command(Reset())
    assert restarted(bench)


def test_laser_mode_is_refused_with_the_cure() -> None:
    bench = Bench(GRBL_11.with_settings({32: 1})).connected()
    with pytest.raises(NotAllowedError, match=r"laser mode.*\$32=0"):
        bench.start(spiral(5)[0])
    assert not bench.do(SendBlock("$32=0")).failure
    bench.start(spiral(5)[0])


def test_what_it_was_tried_on_is_told() -> None:
    assert "GRBL 1.1h compiled for a host with UART pacing" in GrblSession().reporter.facts.tried_on


@pytest.mark.parametrize(
    ("traits", "mist_line", "refused"),
    [
        (GRBL_11, 12, True),
        (GRBL_11, 0, False),
        (replace(GRBL_11, mist=True), 12, False),
        (GRBLHAL, 12, False),
    ],
)
def test_a_mist_that_the_controller_has_not_is_known_before_the_start(
    traits: Traits, mist_line: int, refused: bool
) -> None:
    bench = Bench(traits).connected()
    words = find_missing_option(bench.driver.settings, mist_line=mist_line)
    assert bool(words) is refused and ("line 12: M7" in words) is refused
    assert bench.do(SendBlock("M7")).failure.startswith("M7: error:20") is (not traits.mist)
