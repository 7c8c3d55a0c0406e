"""What others see of a mill: one frozen snapshot, replaced whole at every change."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from machines.driver import DriverFacts, MillState, MillStatus, StreamProgress
from machines.grbl.settings import ControllerSettings
from machines.mill.orders import Lease
from machines.runs import RunView


@dataclass(frozen=True, slots=True)
class LogEntry:
    """Something that happened. `number` counts up; `at_s` is wall clock, seconds since 1970."""

    number: int
    at_s: float
    kind: str  # "state" "run" "fault" "notice" "order" "command" "link" "journal"
    words: str
    answer: dict[str, Any] = dataclasses.field(default_factory=dict)  # of a command
    by: str = ""  # whose order it was, and where that came from
    origin: str = ""

    def as_dict(self) -> dict[str, Any]:
        plain = {"number": self.number, "at_s": self.at_s, "kind": self.kind, "words": self.words}
        said = {"answer": self.answer, "by": self.by, "from": self.origin}
        return plain | {name: value for name, value in said.items() if value}


@dataclass(frozen=True, slots=True, kw_only=True)
class MillSnapshot:
    """All of a mill at one moment.

    settings : what the controller has told of its settings; None where the link does not tell
    run      : the run the mill is about: the live one, else the one touched last
    runs     : all that are known, newest first
    latched  : "hold" or "abort" asked for while the link was away; carried out first when it is back
    problem  : why there is no link, in words
    needs    : what a person has to do before the next start, in words
    zeroed   : axes whose work zero was set on this link, as far as the position is still trusted
    homed    : a homing cycle was carried out on this link, and the position was not lost since
    setup    : digest of what a start rests on: the zero and whether it can be trusted
    stops    : how often the mill was stopped by an order since its owner was started
    lease    : who has control
    events   : the latest, oldest first
    """

    version: int = 0
    name: str = ""
    status: MillStatus = dataclasses.field(default_factory=MillStatus)
    progress: StreamProgress = dataclasses.field(default_factory=StreamProgress)
    protections: tuple[str, ...] = ()
    facts: DriverFacts | None = None
    settings: ControllerSettings | None = None
    run: RunView | None = None
    runs: tuple[RunView, ...] = ()
    latched: str = ""
    problem: str = ""
    needs: tuple[str, ...] = ()
    zeroed: str = ""
    homed: bool = False
    setup: str = ""
    stops: int = 0
    lease: Lease | None = None
    events: tuple[LogEntry, ...] = ()

    @property
    def connected(self) -> bool:
        return self.status.state not in (MillState.DISCONNECTED, MillState.CONNECTING)

    def as_dict(self) -> dict[str, Any]:
        return {
            "version": self.version,
            "name": self.name,
            "connected": self.connected,
            "status": {**_plain(self.status), "state": self.status.state.value},
            "progress": _plain(self.progress),
            "protections": list(self.protections),
            "facts": _plain(self.facts) if self.facts is not None else None,
            "run": self.run.as_dict() if self.run is not None else None,
            "latched": self.latched,
            "problem": self.problem,
            "needs": list(self.needs),
            "zeroed": self.zeroed,
            "homed": self.homed,
            "setup": self.setup,
            "stops": self.stops,
            "control": None if self.lease is None else self.lease.as_dict(),
            "events": [entry.as_dict() for entry in self.events],
        }


def _plain(value: MillStatus | StreamProgress | DriverFacts) -> dict[str, Any]:
    return {name: list(one) if isinstance(one := getattr(value, name), tuple) else one for name in value.__slots__}
