"""Grants, the stop count and control of a mill, by their own clock."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from machines.mill.orders import CARRY_OUT_S, GRANT_S, LEASE_S, Grant, OrderGate, OrderRefusedError, Refusal
from tests.machines.disks import Clock


@pytest.fixture
def clock() -> Clock:
    return Clock(100.0)


@pytest.fixture
def gate(clock: Clock) -> OrderGate:
    numbers = itertools.count()
    return OrderGate(clock, clock, lambda: f"secret {next(numbers)}")


def refusal(act: Callable[[], object]) -> Refusal:
    with pytest.raises(OrderRefusedError) as refused:
        act()
    return refused.value.code


def test_a_grant_is_good_once_and_for_a_moment(gate: OrderGate, clock: Clock) -> None:
    grant = gate.issue_grant()
    gate.redeem(grant.word, "jog")
    assert refusal(lambda: gate.redeem(grant.word, "jog")) is Refusal.UNKNOWN
    late = gate.issue_grant()
    clock.now_s += GRANT_S + 0.01
    assert refusal(lambda: gate.redeem(late.word, "jog")) is Refusal.EXPIRED
    assert refusal(lambda: gate.redeem("", "jog")) is Refusal.MISSING


def test_what_was_begun_in_time_may_take_longer_but_not_for_ever(gate: OrderGate, clock: Clock) -> None:
    permit = gate.redeem(gate.issue_grant().word, "start")
    permit.extend()
    clock.now_s += CARRY_OUT_S - 0.01
    permit.require()
    clock.now_s += 0.02
    assert refusal(permit.require) is Refusal.EXPIRED


def test_a_stop_ends_every_grant_and_every_permit_before_it(gate: OrderGate) -> None:
    held, used = gate.issue_grant(), gate.redeem(gate.issue_grant().word, "resume")
    seen = gate.stops
    gate.count_stop()
    assert refusal(lambda: gate.redeem(held.word, "resume")) is Refusal.STOPPED
    assert refusal(used.require) is Refusal.STOPPED
    assert refusal(lambda: gate.issue_grant(stops_seen=seen)) is Refusal.STOPPED
    gate.redeem(gate.issue_grant(stops_seen=gate.stops).word, "resume")


@pytest.mark.parametrize("change", ["take over", "release", "expire"])
def test_a_grant_ends_with_the_control_it_was_given_under(gate: OrderGate, clock: Clock, change: str) -> None:
    secret, _, new = gate.take_lease("Ada", "ada")
    assert new
    clock.now_s += LEASE_S - 1
    grant: Grant = gate.issue_grant(secret)  # and keeps control
    permit = gate.redeem(gate.issue_grant(secret).word, "jog", needs_lease=True)
    if change == "take over":
        gate.take_lease("Bob", "bob", take_over=True)
    elif change == "release":
        assert gate.release_lease(secret)
    else:
        clock.now_s += LEASE_S + 1
    expected = Refusal.EXPIRED if change == "expire" else Refusal.LEASE
    assert {refusal(permit.require), refusal(lambda: gate.redeem(grant.word, "jog"))} == {expected}


def test_one_person_at_a_time_has_control_as_long_as_they_are_heard_of(gate: OrderGate, clock: Clock) -> None:
    secret, lease, _ = gate.take_lease("Ada", "ada")
    clock.now_s += LEASE_S - 1
    assert gate.take_lease("Ada", "ada", secret) == (secret, lease, False)
    clock.now_s += LEASE_S - 1
    assert refusal(lambda: gate.take_lease("Bob", "bob")) is Refusal.HELD
    assert refusal(lambda: gate.issue_grant("not hers")) is Refusal.HELD
    clock.now_s += 2
    assert gate.get_lease() is None
    assert refusal(lambda: gate.issue_grant(secret)) is Refusal.LOST
    grant = gate.issue_grant()
    gate.redeem(grant.word, "start")
    assert refusal(lambda: gate.redeem(gate.issue_grant().word, "jog", needs_lease=True)) is Refusal.NOBODY


def test_who_asks_for_grants_is_heard_of(gate: OrderGate, clock: Clock) -> None:
    """Somebody who jogs for minutes asks for nothing but grants, and keeps control."""
    secret, lease, _ = gate.take_lease("Ada", "ada")
    for _ in range(3):
        clock.now_s += LEASE_S - 1
        gate.issue_grant(secret)
    assert gate.get_lease() == lease


def test_callers_who_ask_and_never_order_are_forgotten(gate: OrderGate, clock: Clock) -> None:
    for _ in range(5000):
        gate.issue_grant()
        clock.now_s += 0.0001
    assert len(gate._grants) <= 1000
