"""Keys and Ctrl-C during a run: a hold is never more than one key away, an abort never less than two."""

from __future__ import annotations

import os
import termios

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.milling.terminal.keys import Keys, Question, Wish, keys_in, single_keys

INTERRUPT = "^C"


def wishes(keys: Keys, pressed: list[str]) -> list[Wish | None]:
    return [keys.interrupt() if key == INTERRUPT else keys.key(key) for key in pressed]


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
    assert wishes(Keys(), pressed)[-1] == last


@given(st.lists(st.sampled_from(["h", "r", "a", "y", "n", "+", "-", "q", "l", "x", INTERRUPT]), max_size=12))
def test_no_key_resumes_or_leaves_a_run_that_is_being_aborted_and_no_single_key_aborts(pressed: list[str]) -> None:
    keys = Keys()
    for key in pressed:
        before = keys.question
        wish = wishes(keys, [key])[0]
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
