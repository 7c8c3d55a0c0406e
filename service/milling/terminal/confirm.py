"""Input of the person at this terminal: answers to questions before a run; orders, each under a grant from the moment
of its key; and stops, which are sent at once.
"""

from __future__ import annotations

import contextlib
import getpass
import sys
from collections.abc import Callable, Mapping
from typing import TypeVar

from machines.errors import MachineError
from machines.mill.mill import Mill
from machines.mill.orders import Caller, Stop
from machines.mill.thread import MillThread
from service.errors import InputError

START_QUESTIONS = {
    "tool": "The right tool is in the spindle",
    "zero": "Work zero is set on this stock",
    "stock": "The stock is clamped",
    "clear": "Nobody and nothing is in the way of the mill",
}
RECOVER_QUESTIONS = START_QUESTIONS | {"position": "The mill's position is right (see above)"}
FRAME_QUESTIONS = {
    "zero": START_QUESTIONS["zero"],
    "clear": "The tool may go up to the safe height and around the outline: nothing is in the way",
}
_GIVEN_BY = dict.fromkeys(START_QUESTIONS, "--yes") | {"position": "--confirm-position"}


def operator_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a user without a name
        return "unknown"


def require_answers(questions: Mapping[str, str], given: frozenset[str]) -> None:
    """Raise InputError if nobody can be asked and the command line leaves a question open: silence is no answer."""
    missing: dict[str, list[str]] = {}
    for check, sentence in questions.items():
        if check not in given:
            missing.setdefault(_GIVEN_BY[check], []).append(f"'{sentence.partition(' (')[0]}'")
    if missing:
        means = "; ".join(f"{option} says in your name: {', '.join(said)}" for option, said in missing.items())
        raise InputError(
            f"a person has to confirm this, and stdin or stdout is no terminal: nothing was sent. "
            f"Run it on a terminal, or add {' '.join(missing)}. {means}"
        )


def ask_person(questions: dict[str, str]) -> frozenset[str]:
    """Ask one question after the other. The first answer other than yes ends the command with nothing sent."""
    for check, sentence in questions.items():
        print(f"{sentence}? [y/N] ", end="", flush=True)
        answer = sys.stdin.readline()
        if answer.strip().lower() not in ("y", "yes"):
            raise InputError(f"not confirmed ({check}); nothing was started")
    return frozenset(questions)


T = TypeVar("T")

_ORIGIN = "terminal"


def give_order(thread: MillThread, doing: str, act: Callable[[Mill], T]) -> T:
    """Carry out `act` now; MachineError if it is refused. It is never carried out late or after a stop."""
    grant = thread.orders.issue_grant()
    caller = Caller(name=operator_name(), origin=_ORIGIN, grant=grant.word)
    return thread.call(lambda mill: mill.carry_out(doing, act, caller))


def stop_mill(thread: MillThread, stop: Stop) -> None:
    """Hold or abort; never waits."""
    with contextlib.suppress(MachineError):  # its thread has ended: the follower notices and reports that
        thread.halt(stop, Caller(name=operator_name(), origin=_ORIGIN))
