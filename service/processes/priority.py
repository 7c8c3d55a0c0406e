"""Who goes first where a computer has too much to do: agents of mills, then servers, then whatever computes."""

from __future__ import annotations

import contextlib
import os

FIRST, BEHIND = -5, 10  # of nice; 0 is what servers have


def go_first() -> None:
    """Raise the priority of this thread and all that it starts from now on, where the system permits it.

    It does so to root, with CAP_SYS_NICE, and as far as RLIMIT_NICE goes; elsewhere nothing changes.
    """
    _set_nice(min(FIRST, _read_nice()))


def give_way() -> None:
    """Lower the priority of this thread and all that it starts from now on; one that is further behind stays there."""
    _set_nice(max(BEHIND, _read_nice()))


def _read_nice() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0)


def _set_nice(nice: int) -> None:
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
