"""Character counting and pacing: never more under way than fits, never long queues before the wire."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.grbl.flow_control import AHEAD_S, Pacer, SendWindow, usable_bytes


@given(st.lists(st.one_of(st.integers(1, 80), st.none()), max_size=200), st.integers(80, 200))
def test_never_more_than_the_capacity_is_under_way_and_each_line_is_answered_once(
    steps: list[int | None], capacity: int
) -> None:
    """None answers the oldest line, a number tries to send a line of that size."""
    window: SendWindow[int] = SendWindow(capacity)
    sent, answered = [], []
    for step in steps:
        if step is None:
            if len(window):
                answered.append(window.take_answer())
        elif window.accepts(step):
            window.note_sent(step, len(sent))
            sent.append(step)
        else:
            with pytest.raises(AssertionError):
                window.note_sent(step, -1)
        assert window.used == sum(sent[len(answered) :]) <= capacity
    assert answered == list(range(len(answered)))


def test_an_answer_to_nothing_is_refused() -> None:
    with pytest.raises(IndexError):
        SendWindow[int](127).take_answer()


def test_one_byte_of_the_reported_buffer_is_left_free() -> None:
    assert (usable_bytes(128), usable_bytes(None), usable_bytes(1024)) == (127, 127, 1023)


@given(st.lists(st.tuples(st.floats(0, 0.02), st.integers(1, 200)), max_size=100))
def test_less_than_ten_milliseconds_wait_before_the_wire(writes: list[tuple[float, int]]) -> None:
    rate, now_s, empty_s = 11520.0, 0.0, 0.0
    pacer = Pacer(rate)
    for pause_s, wanted in writes:
        now_s += pause_s
        count = min(wanted, max(0, pacer.budget(now_s)))
        pacer.note_written(count, now_s)
        empty_s = max(empty_s, now_s) + count / rate
        assert empty_s - now_s <= AHEAD_S + 1e-9


def test_a_paced_wire_never_falls_idle() -> None:
    """Written at each refill time, all of the wire is used."""
    pacer, now_s, total = Pacer(11520.0), 0.0, 0
    while now_s < 1.0:
        count = pacer.budget(now_s)
        pacer.note_written(count, now_s)
        total += count
        now_s = max(now_s + 1e-6, pacer.refill_at_s)
    assert total >= 11520 * 0.99
