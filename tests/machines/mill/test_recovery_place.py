"""Whether the position is known still: after resets of our own, on new links, after a setting was changed."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from machines.driver import Home, Jog, MillState, Reset, SendBlock, TrustPosition
from machines.errors import NotAllowedError
from machines.runs import RunState
from tests.machines.shop import YES, YES_ALL, Shop


def refuse_a_line(shop: Shop) -> None:
    shop.bench.sim.firmware.say("error:20")
    shop.until(RunState.INTERRUPTED)


def lose_power_unseen(shop: Shop) -> None:
    """Nobody hears its banner."""
    shop.bench.kill(host_power=False)
    shop.bench.sim.unplug()
    shop.bench.sim.power_cycle()
    shop.bench.sim.advance(shop.bench.sim.now_s + 5.0)
    shop.bench.sim.replug()
    shop.bench.mill = shop.bench.new_mill()


@pytest.mark.parametrize("stop", [Shop.aborted, refuse_a_line])
@pytest.mark.parametrize("resets", [0, 1, 2])
def test_after_our_own_reset_from_standstill_the_next_process_knows_the_position(
    shop: Shop, stop: Callable[[Shop], object], resets: int
) -> None:
    """And cuts every line; GRBL counts on, whoever looks."""
    stop(shop.started(10))
    shop.bench.until_state(MillState.IDLE)
    for _ in range(resets):
        shop.replace_owner(MillState.IDLE)
        shop.bench.sim.press("hold")
        shop.bench.until_state(MillState.HELD)
        shop.mill.command(Reset())
        shop.bench.until_state(MillState.IDLE)
    shop.replace_owner(MillState.IDLE)
    assert shop.needs == []
    shop.mill.recover(shop.id, YES_ALL)
    shop.until(RunState.FINISHED)


@pytest.mark.parametrize("lost", [False, True])
def test_a_mill_that_was_left_held_is_reset_and_its_position_kept(shop: Shop, lost: bool) -> None:
    """The words at the reset promise it, and the next plan keeps the promise; but not where the power was off."""
    shop.started(10).held()
    shop.replace_owner(MillState.HELD)
    assert shop.needs == ["stand still"]
    if lost:
        shop.bench.sim.power_cycle()
        shop.bench.until(lambda: shop.mill.status.epoch > 0)
    else:
        shop.mill.command(Reset())
    shop.bench.until_state(MillState.IDLE)
    assert shop.needs == (["position"] if lost else [])


@pytest.mark.parametrize("stop", [Shop.aborted, refuse_a_line])
def test_a_mill_that_lost_its_power_meanwhile_is_not_where_it_was_left(
    shop: Shop, stop: Callable[[Shop], object]
) -> None:
    stop(shop.started(10))
    shop.bench.until_state(MillState.IDLE)
    lose_power_unseen(shop)
    shop.bench.until_state(MillState.IDLE)
    assert shop.needs == ["position"]


def test_a_reset_proves_nothing_of_a_mill_that_was_in_doubt_before_it(shop: Shop) -> None:
    """Its power was off while nobody looked; then it was jogged, held and reset by us."""
    shop.started(10).aborted()
    lose_power_unseen(shop)
    shop.bench.until_state(MillState.IDLE)
    shop.bench.command_done(Jog((5.0, 5.0, 3.0), 900.0))
    shop.bench.sim.press("hold")
    shop.bench.until_state(MillState.HELD)
    shop.mill.command(Reset())
    shop.bench.until_state(MillState.IDLE)
    assert shop.needs == ["position"]
    shop.replace_owner(MillState.IDLE)
    assert shop.needs == ["position"]


def test_a_plan_is_shown_when_every_field_it_rests_on_has_come(shop: Shop) -> None:
    """GRBL reports its spindle with every tenth report: a plan made before would be another one soon after."""
    shop.started(10)
    shop.bench.sim.unplug()
    shop.until(RunState.INTERRUPTED)
    shop.pass_s(30.0)
    shop.bench.sim.replug()
    for _ in range(3):
        shop.replace_owner(MillState.IDLE)
        plan = shop.mill.plan_recovery(shop.id)
        assert plan.spindle_on is True
        for _ in range(12):
            shop.pass_s(0.3)
            assert shop.mill.plan_recovery(shop.id).digest == plan.digest
    shop.mill.recover(shop.id, YES_ALL, plan_seen=plan.digest)
    shop.until(RunState.FINISHED)


CHANGES = ["$100=252", "$101=248.5", "$102=251", "$3=1", "$23=3", "$27=2", "$130=290"]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("replaced", [False, True])
def test_a_setting_of_the_frame_that_changes_before_a_recovery_is_asked_for(
    shop: Shop, change: str, replaced: bool
) -> None:
    """By the console of this owner, or before another one came. A person's word is for the settings as they are."""
    shop.started(10).aborted()
    number = int(change[1:].partition("=")[0])
    before = shop.bench.sim.firmware.settings[number]
    shop.bench.command_done(SendBlock(change))
    assert not shop.mill.status.position_trusted
    assert any(f"${number} " in entry.words for entry in shop.mill.snapshot.events if entry.kind == "notice")
    if replaced:
        shop.replace_owner(MillState.IDLE)
    plan = shop.mill.plan_recovery(shop.id)
    assert [need.code for need in plan.needs] == ["position"]
    assert f"${number} " in plan.needs[0].words
    with pytest.raises(NotAllowedError):
        shop.mill.recover(shop.id, YES_ALL)
    shop.bench.command_done(TrustPosition())
    assert shop.needs == []
    shop.bench.command_done(SendBlock(f"${number}={before:g}"))
    assert shop.needs == ["position"]


def test_homing_does_not_settle_a_frame_in_which_the_part_was_not_cut(shop: Shop) -> None:
    shop.started(10).aborted()
    shop.bench.command_done(SendBlock("$22=1"))
    shop.bench.command_done(SendBlock("$100=252"))
    shop.bench.command_done(Home())
    assert shop.mill.status.position_trusted
    assert shop.needs == ["position"]


def test_the_word_for_another_program_is_none_for_this_one(shop: Shop) -> None:
    """Its start makes the place a reference, for what is cut from there on."""
    shop.started(10).aborted()
    shop.bench.command_done(SendBlock("$100=252"))
    other = shop.mill.park(shop.facts, shop.path, "another").id
    shop.mill.start(other, YES)
    shop.mill.abort()
    shop.bench.until_state(MillState.IDLE)
    assert shop.needs == ["position"]


def test_a_jog_that_the_link_has_seen_raises_no_doubt(shop: Shop) -> None:
    shop.started(10).aborted()
    shop.bench.command_done(Jog((0.0, 0.0, 3.0), 900.0))
    shop.bench.until_state(MillState.IDLE)
    assert shop.needs == []


def test_a_link_that_never_reports_its_spindle_is_waited_for_once(shop: Shop) -> None:
    """grblHAL leaves the field out where $10 says so: the plan says that it is not known, and is the same each time."""
    firmware = shop.bench.sim.firmware
    shop.started(10).aborted()
    shop.replace_owner(MillState.CONNECTING)
    digests, took_s = set(), []
    while len(took_s) < 4:
        firmware.ov_in = 10**6
        begun_s = shop.bench.sim.now_s
        shop.bench.until_state(MillState.IDLE)
        plan = shop.mill.plan_recovery(shop.id)
        assert plan.spindle_on is None and plan.ready
        assert any("not known" in words for words in plan.words)
        digests.add(plan.digest)
        took_s.append(shop.bench.sim.now_s - begun_s)
    assert len(digests) == 1
    assert max(took_s[1:]) < 1.0
