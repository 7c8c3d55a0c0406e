"""How this terminal gives orders and stops: an order under a grant of the moment of its key, a stop at once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import TypeVar

from machines.errors import MachineError
from machines.mill.mill import Mill
from machines.mill.orders import Caller, Stop
from machines.mill.thread import MillThread
from service.milling.terminal.confirm import operator_name

T = TypeVar("T")

_ORIGIN = "terminal"


def give_order(thread: MillThread, doing: str, act: Callable[[Mill], T]) -> T:
    """Have `act` carried out now; MachineError where that is refused. After a later stop, or too late, it never is."""
    grant = thread.orders.issue_grant()
    caller = Caller(name=operator_name(), origin=_ORIGIN, grant=grant.word)
    return thread.call(lambda mill: mill.carry_out(doing, act, caller))


def stop_mill(thread: MillThread, stop: Stop) -> None:
    """Hold or abort; never waits."""
    with contextlib.suppress(MachineError):  # its thread has ended: that is seen, and said, by whoever follows it
        thread.halt(stop, Caller(name=operator_name(), origin=_ORIGIN))
