"""Keys and Ctrl-C during a run: a hold is never more than one key away, an abort never less than two."""

from __future__ import annotations

import os
import termios

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.milling.terminal.keys import APART_S, Keys, Question, Wish, keys_in, single_keys

INTERRUPT = "^C"


class Pressed:
    """Keys pressed one after the other, each `apart_s` after the one before."""

    def __init__(self, apart_s: float = APART_S) -> None:
        self.now_s, self.apart_s = 0.0, apart_s
        self.keys = Keys(clock=lambda: self.now_s)

    def press(self, key: str) -> Wish | None:
        self.now_s += self.apart_s
        return self.keys.interrupt() if key == INTERRUPT else self.keys.key(key)


@pytest.mark.parametrize(
    ("pressed", "last"),
    [
        (["h"], Wish.HOLD),
        ([" "], Wish.HOLD),
        (["!"], Wish.HOLD),
        (["~"], Wish.RESUME),
        (["+"], Wish.FASTER),
        (["-"], Wish.SLOWER),
        (["a"], None),
        (["a", "y"], Wish.ABORT),
        (["a", "n"], None),
        (["a", "h"], Wish.HOLD),
        (["q"], Wish.HOLD),
        (["q", "r"], Wish.RESUME),
        (["q", "l"], Wish.LEAVE),
        (["q", "a"], Wish.ABORT),
        (["l"], None),
        (["y"], None),
        ([INTERRUPT], Wish.HOLD),
        ([INTERRUPT, "r"], Wish.RESUME),
        ([INTERRUPT, "l"], Wish.LEAVE),
        ([INTERRUPT, INTERRUPT], Wish.ABORT),
        (["a", INTERRUPT], Wish.HOLD),
        (["a", INTERRUPT, INTERRUPT], Wish.ABORT),
        ([INTERRUPT, "r", INTERRUPT], Wish.HOLD),
        ([INTERRUPT, INTERRUPT, INTERRUPT], Wish.GIVE_UP),
        ([INTERRUPT, INTERRUPT, "r"], None),
    ],
)
def test_what_a_sequence_of_keys_ends_in(pressed: list[str], last: Wish | None) -> None:
    person = Pressed()
    assert [person.press(key) for key in pressed][-1] == last


@given(
    st.lists(st.floats(0.0, 0.99 * APART_S), max_size=40),
    st.sampled_from([[], ["q"], [INTERRUPT], [INTERRUPT, INTERRUPT]]),
)
def test_a_ctrl_c_held_down_is_one_press(gaps_s: list[float], before: list[str]) -> None:
    """However long it is held: a terminal repeats the key every 33 ms, and none of that quits without waiting."""
    person = Pressed()
    for key in before:
        person.press(key)
    first, answered = person.press(INTERRUPT), person.keys.question
    assert first is not None
    for person.apart_s in gaps_s:
        assert person.press(INTERRUPT) is None
        assert person.keys.question is answered
        assert "Ctrl-C" not in person.keys.prompt
    person.apart_s = APART_S
    assert person.press(INTERRUPT) is (Wish.ABORT if answered is Question.STOP else Wish.GIVE_UP)


def test_a_ctrl_c_holds_at_any_time() -> None:
    person = Pressed(apart_s=0.1)
    for _ in range(3):
        assert person.press(INTERRUPT) is Wish.HOLD
        assert person.press("r") is Wish.RESUME


def test_what_a_ctrl_c_would_do_is_shown_when_it_would_do_it_in_one_row() -> None:
    person = Pressed()
    prompts = {person.keys.prompt}
    for _ in range(3):
        person.press(INTERRUPT)
        prompts.add(person.keys.prompt)
        person.now_s += APART_S
        prompts.add(person.keys.prompt)
    assert any("Ctrl-C again: abort" in words for words in prompts)
    assert any("Ctrl-C: quit without waiting" in words for words in prompts)
    assert max(map(len, prompts)) <= 76


@given(st.lists(st.sampled_from(["h", "r", "a", "y", "n", "+", "-", "q", "l", "x", INTERRUPT]), max_size=12))
def test_no_key_resumes_or_leaves_a_run_that_is_being_aborted_and_no_single_key_aborts(pressed: list[str]) -> None:
    person, keys = (made := Pressed()), made.keys
    for key in pressed:
        before = keys.question
        wish = person.press(key)
        if wish is Wish.ABORT:
            assert before in (Question.STOP, Question.ABORT)
        if before is Question.ABORTING:
            assert wish in (None, Wish.GIVE_UP)
            assert keys.question is Question.ABORTING
        if key == INTERRUPT:
            assert wish in (Wish.HOLD, Wish.ABORT, Wish.GIVE_UP)


def test_arrows_and_function_keys_are_not_letters() -> None:
    assert keys_in(b"\x1b[A\x1bOPh\x1b[15~\x1b[1;5Cr\xff\x1b") == "hr"


def test_the_terminal_is_given_back_as_it_was_and_cannot_be_suspended_meanwhile() -> None:
    master, terminal = os.openpty()
    try:
        before = termios.tcgetattr(terminal)
        with single_keys(terminal):
            inside = termios.tcgetattr(terminal)
            assert not inside[3] & (termios.ICANON | termios.ECHO)
            assert inside[3] & termios.ISIG
            assert inside[6][termios.VSUSP] == inside[6][termios.VQUIT] == b"\0"
            assert not inside[0] & termios.IXON
        assert termios.tcgetattr(terminal) == before
    finally:
        os.close(master)
        os.close(terminal)
