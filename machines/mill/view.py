"""The data of a mill: its log, the context that the parts of its owner share, and the snapshot that others see."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, overload

from machines.driver import DriverFacts, MillState, MillStatus, StreamProgress
from machines.grbl.settings import ControllerSettings
from machines.mill.link import MillLink, get_settings
from machines.mill.orders import NOBODY, Caller, Lease, OrderGate
from machines.mill.run_store import RunStore
from machines.runs import RunReport
from phrases.phrase import NO_WORDS, Phrase, phrases_in

LOG_ENTRIES = 200
SHOWN_RUNS = 100


@dataclass(frozen=True, slots=True)
class LogEntry:
    """Something that happened. `number` counts up; `at_s`: seconds since 1970; `code`: of MillCode or Stop, or ""."""

    number: int
    at_s: float
    kind: str  # "state" "run" "fault" "notice" "order" "command" "link" "journal"
    words: str
    code: str = ""
    values: dict[str, Any] = dataclasses.field(default_factory=dict)
    answer: dict[str, Any] = dataclasses.field(default_factory=dict)  # of a command
    by: str = ""  # who gave the order, and from where
    origin: str = ""

    def as_dict(self) -> dict[str, Any]:
        plain = {"number": self.number, "at_s": self.at_s, "kind": self.kind, "words": self.words}
        said = {
            "code": self.code, "values": self.values, "answer": self.answer, "by": self.by, "from": self.origin,
        }  # fmt: skip
        entry = plain | {name: value for name, value in said.items() if value}
        return entry | ({"phrases": phrases} if (phrases := phrases_in(entry)) else {})


class MillLog:
    """The recent events of the mill, numbered. `wall_clock` gives seconds since 1970."""

    def __init__(self, wall_clock: Callable[[], float]) -> None:
        self._wall = wall_clock
        self._entries: deque[LogEntry] = deque(maxlen=LOG_ENTRIES)
        self.count = 0

    @overload
    def say(self, kind: Literal["state"], words: str) -> None: ...
    @overload
    def say(
        self, kind: str, words: Phrase, answer: Mapping[str, object] | None = None, caller: Caller = NOBODY
    ) -> None: ...
    @overload
    def say(
        self,
        kind: str,
        words: str,
        answer: Mapping[str, object] | None = None,
        caller: Caller = NOBODY,
        *,
        code: str,
        values: Mapping[str, object] | None = None,
    ) -> None: ...
    def say(
        self,
        kind: str,
        words: str,
        answer: Mapping[str, object] | None = None,
        caller: Caller = NOBODY,
        *,
        code: str = "",
        values: Mapping[str, object] | None = None,
    ) -> None:
        """Add an entry. The page has its own words for states and codes; anything else is a phrase."""
        self.count += 1
        entry = LogEntry(
            number=self.count,
            at_s=round(self._wall(), 3),
            kind=kind,
            words=words,
            code=code,
            values=dict(values or {}),
            answer=dict(answer or {}),
            by=caller.name,
            origin=caller.origin,
        )
        self._entries.append(entry)

    def after(self, known: tuple[LogEntry, ...]) -> tuple[LogEntry, ...]:
        """Return all entries; the caller's own tuple if nothing was added."""
        return known if known and known[-1].number == self.count else tuple(self._entries)


@dataclass(frozen=True, slots=True, kw_only=True)
class MillContext:
    """The context that the parts of a mill's owner share.

    clock, wall_clock : seconds of a clock that nobody sets; seconds since 1970
    """

    link: MillLink
    runs: RunStore
    log: MillLog
    orders: OrderGate
    clock: Callable[[], float]
    wall_clock: Callable[[], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MillSnapshot:
    """The state of a mill at one moment.

    settings : as the controller has reported them; None if the link reports none
    run      : the current run: the live one, else the last one
    runs     : all that are known, newest first
    latched  : "hold" or "abort" ordered while the link was away; carried out first when it is back
    problem  : why there is no link, in words
    needs    : what a person has to do before the next start, in words
    zeroed   : axes whose work zero was set on this link, as far as the position is still trusted
    zeroed_anew : those of them that were set since a program last started
    homed    : a homing cycle was carried out on this link, and the position was not lost since
    setup    : digest of the facts on which a start depends: the zero and whether it can be trusted
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
    run: RunReport | None = None
    runs: tuple[RunReport, ...] = ()
    latched: str = ""
    problem: Phrase = NO_WORDS
    needs: tuple[Phrase, ...] = ()
    zeroed: str = ""
    zeroed_anew: str = ""
    homed: bool = False
    setup: str = ""
    stops: int = 0
    lease: Lease | None = None
    events: tuple[LogEntry, ...] = ()

    @property
    def connected(self) -> bool:
        return self.status.state not in (MillState.DISCONNECTED, MillState.CONNECTING)

    def as_dict(self) -> dict[str, Any]:
        snapshot = {
            "version": self.version,
            "name": self.name,
            "connected": self.connected,
            "status": {**_plain(self.status), "state": self.status.state.value},
            "progress": _plain(self.progress),
            "protections": list(self.protections),
            "facts": _plain(self.facts) if self.facts is not None else None,
            "latched": self.latched,
            "problem": self.problem,
            "needs": list(self.needs),
            "zeroed": self.zeroed,
            "zeroed_anew": self.zeroed_anew,
            "homed": self.homed,
            "setup": self.setup,
            "stops": self.stops,
            "control": None if self.lease is None else self.lease.as_dict(),
        }
        return snapshot | {
            "phrases": phrases_in(snapshot),
            "run": self.run.as_dict() if self.run is not None else None,
            "events": [entry.as_dict() for entry in self.events],
        }


def _plain(value: MillStatus | StreamProgress | DriverFacts) -> dict[str, Any]:
    return {name: list(one) if isinstance(one := getattr(value, name), tuple) else one for name in value.__slots__}


class SnapshotPublisher:
    """Owns the snapshot: `snapshot` may be read from any thread."""

    def __init__(self, name: str, context: MillContext) -> None:
        self._link = context.link
        self._runs = context.runs
        self._log = context.log
        self._orders = context.orders
        self.snapshot = MillSnapshot(name=name)

    def publish(self) -> None:
        """Replace the snapshot if anything in it differs."""
        link, driver, before = self._link, self._link.driver, self.snapshot
        status, needs, active = link.status, self._runs.needs(), self._runs.active
        snapshot = replace(
            before,
            status=status if driver is not None else replace(status, detail=link.problem),
            progress=driver.progress if driver is not None else before.progress,
            protections=driver.protections if driver is not None else (),
            facts=driver.facts if driver is not None else before.facts,
            settings=get_settings(driver) if driver is not None else before.settings,
            run=active.view if active is not None else None,
            runs=self._runs.views(SHOWN_RUNS),
            latched=link.latched,
            problem=link.problem,
            needs=needs,
            zeroed=link.setup.zeroed,
            zeroed_anew=link.setup.zeroed_anew,
            homed=link.setup.homed,
            setup=link.setup.digest(status, needs),
            stops=self._orders.stops,
            lease=self._orders.get_lease(),
            events=self._log.after(before.events),
        )
        if snapshot != before:
            self.snapshot = replace(snapshot, version=before.version + 1)
