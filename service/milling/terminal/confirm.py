"""Questions before a run, answered by a person at the terminal."""

from __future__ import annotations

import getpass
import sys

from service.errors import InputError

START_QUESTIONS = {
    "tool": "The right tool is in the spindle",
    "zero": "Work zero is set on this stock",
    "stock": "The stock is clamped",
    "clear": "Nobody and nothing is in the way of the mill",
}
RECOVER_QUESTIONS = START_QUESTIONS | {"position": "The mill's position is right (see above)"}


def operator_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a user without a name
        return "unknown"


def ask_person(questions: dict[str, str]) -> frozenset[str]:
    """Ask one by one; the first answer that is not yes ends the command with nothing sent."""
    for check, sentence in questions.items():
        print(f"{sentence}? [y/N] ", end="", flush=True)
        answer = sys.stdin.readline()
        if answer.strip().lower() not in ("y", "yes"):
            raise InputError(f"not confirmed ({check}); nothing was started")
    return frozenset(questions)
