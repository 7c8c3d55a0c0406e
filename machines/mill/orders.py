"""Decides whether an order may still be carried out, by the grants, the stop count and the lease of one mill.

An order is anything that can start motion or change what a motion means. It is carried out under a grant: a secret that
is issued when a person asks for it and that one order may use, once, within `GRANT_S` on this clock. A grant ends with
the next stop (the stop count has risen), with a change of the lease (somebody else has control), and with this process,
so neither a slow network nor a duplicate nor a restart can revive an old order. Nothing here compares the clocks of two
computers.

A stop needs no grant and waits for nothing: it raises the count in every state.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from machines.clock import suspend_aware_clock_s
from machines.errors import NotAllowedError

GRANT_S = 3.0  # from the moment a person asks to the moment the order is begun
CARRY_OUT_S = 10.0  # a start asks the controller first: until its first byte leaves
LEASE_S = 60.0
STOP_S = 1.0  # a stop is answered within this time, even while the mill's thread waits
_MOST_GRANTS = 1000
_NO_GRANT = (
    "not carried out: an order needs a grant. POST .../grants hands one out; send it with the order, as "
    f"Causticmill-Grant, within {GRANT_S:g} s"
)


class Stop(StrEnum):
    """Orders that end motion, which anyone may give at any time."""

    HOLD = "hold"
    ABORT = "abort"
    JOG_CANCEL = "jog-cancel"


class Refusal(StrEnum):
    """Codes, for programs, of the reasons why an order is not carried out."""

    MISSING = "grant_missing"
    UNKNOWN = "grant_unknown"  # never issued here, or already used
    EXPIRED = "grant_expired"
    STOPPED = "grant_stopped"
    LEASE = "grant_lease"
    HELD = "control_held"  # by someone else
    LOST = "control_lost"  # by the caller, without a successor
    NOBODY = "control_needed"
    PLAN = "plan_changed"
    SETUP = "setup_changed"


class OrderRefusedError(NotAllowedError):
    """An order that is not carried out; `code` is the reason. holder: who has control, if that is the reason."""

    def __init__(self, code: Refusal, words: str, holder: Lease | None = None) -> None:
        super().__init__(words, code=code, values={} if holder is None else {"operator": holder.operator})
        self.holder = holder


@dataclass(frozen=True, slots=True, kw_only=True)
class Lease:
    """Control of a mill. since_s: seconds since 1970; number: counts the changes of control."""

    operator: str
    principal: str
    since_s: float
    number: int
    digest: str

    def as_dict(self) -> dict[str, object]:
        """Return its public part."""
        return {"operator": self.operator, "principal": self.principal, "since_s": self.since_s}


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """The permission for one order."""

    word: str
    issued_s: float
    stops: int
    halts: int  # stops without the ends of jogs
    lease: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Caller:
    """The person who gives an order. origin: where it came from; grant: under which it is given."""

    name: str = ""
    origin: str = ""
    grant: str = ""


NOBODY = Caller()


class OrderGate:
    """Hands out grants and redeems them; may be used from any thread. No call waits.

    clock : seconds that pass while the computer is suspended, too. wall_clock : seconds since 1970
    """

    def __init__(
        self,
        clock: Callable[[], float] = suspend_aware_clock_s,
        wall_clock: Callable[[], float] = time.time,
        make_secret: Callable[[], str] = lambda: secrets.token_urlsafe(18),
    ) -> None:
        self._clock = clock
        self._wall = wall_clock
        self._make_secret = make_secret
        self._lock = threading.Lock()
        self._stops = self._halts = 0
        self._grants: dict[str, Grant] = {}
        self._lease: Lease | None = None
        self._renewed_s = 0.0
        self._leases = 0

    # ------------------------------------------------------------------ stops

    @property
    def stops(self) -> int:
        return self._stops

    def count_stop(self, stop: Stop = Stop.HOLD) -> int:
        """End every grant issued so far."""
        with self._lock:
            self._stops += 1
            self._halts += stop is not Stop.JOG_CANCEL
            return self._stops

    # ------------------------------------------------------------------ control

    def get_lease(self) -> Lease | None:
        """Return who has control now."""
        with self._lock:
            return self._live_lease()

    def take_lease(
        self, operator: str, principal: str, shown: str = "", *, take_over: bool = False
    ) -> tuple[str, Lease, bool]:
        """Return the secret, the lease and whether it is new. OrderRefusedError if somebody else has control."""
        with self._lock:
            lease = self._live_lease()
            if lease is not None and _is_secret_of(lease, shown):
                self._renewed_s = self._clock()
                return shown, lease, False
            if lease is not None and not take_over:
                raise _make_held_error(lease)
            secret = self._make_secret()
            self._leases += 1
            self._lease = Lease(
                operator=operator,
                principal=principal,
                since_s=round(self._wall(), 3),
                number=self._leases,
                digest=_digest(secret),
            )
            self._renewed_s = self._clock()
            return secret, self._lease, True

    def release_lease(self, shown: str) -> bool:
        """Release control if this holder has it; return whether they had it."""
        with self._lock:
            lease = self._live_lease()
            if lease is None or not _is_secret_of(lease, shown):
                return False
            self._lease = None
            return True

    def require_free(self, shown: str = "") -> None:
        """Raise OrderRefusedError if somebody else has control."""
        with self._lock:
            self._require_own_lease(shown)

    # ------------------------------------------------------------------ grants

    def issue_grant(self, shown: str = "", *, stops_seen: int | None = None) -> Grant:
        """Issue a grant to the holder of control, whose lease it renews, or to anyone if no one has control.

        stops_seen : the stop count as the person saw it when they pressed; a stop that has overtaken this request was
        pressed later and takes precedence
        """
        with self._lock:
            lease = self._require_own_lease(shown)
            if lease is None and shown:
                raise OrderRefusedError(
                    Refusal.LOST, "you had control and have not been heard of for too long: take control again"
                )
            if stops_seen is not None and stops_seen != self._stops:
                raise OrderRefusedError(Refusal.STOPPED, "not carried out: the mill was stopped since")
            now_s = self._clock()
            if lease is not None:
                self._renewed_s = now_s
            self._forget_old(now_s)
            grant = Grant(
                word=self._make_secret(),
                issued_s=now_s,
                stops=self._stops,
                halts=self._halts,
                lease=None if lease is None else lease.number,
            )
            self._grants[grant.word] = grant
            return grant

    def redeem(self, word: str, doing: str, *, needs_lease: bool = False) -> Permit:
        """Use up a grant; return the permit, which is valid until the order is carried out. OrderRefusedError.

        needs_lease : the order needs control even if no one has it
        """
        if not word:
            raise OrderRefusedError(Refusal.MISSING, f"{doing}: {_NO_GRANT}")
        with self._lock:
            grant = self._grants.pop(word, None)
        if grant is None:
            raise OrderRefusedError(
                Refusal.UNKNOWN, f"{doing}: not carried out: it came twice, is too old, or the agent was started anew"
            )
        permit = Permit(self, grant, doing, needs_lease=needs_lease)
        permit.require()
        return permit

    def _forget_old(self, now_s: float) -> None:
        for word, grant in list(self._grants.items()):
            if now_s > grant.issued_s + GRANT_S or len(self._grants) >= _MOST_GRANTS:
                del self._grants[word]
            else:
                break

    def _require_own_lease(self, shown: str) -> Lease | None:
        """Return the caller's lease, or None if nobody has control; OrderRefusedError if somebody else has."""
        lease = self._live_lease()
        if lease is not None and not _is_secret_of(lease, shown):
            raise _make_held_error(lease, lost=bool(shown))
        return lease

    def _live_lease(self) -> Lease | None:
        if self._lease is not None and self._clock() >= self._renewed_s + LEASE_S:
            self._lease = None
        return self._lease


class Permit:
    """An order under way: `require` raises as soon as it may not be carried out any more."""

    def __init__(self, gate: OrderGate, grant: Grant, doing: str, *, needs_lease: bool) -> None:
        self._gate = gate
        self._grant = grant
        self._doing = doing
        self._needs_lease = needs_lease
        self._limit_s = GRANT_S

    def extend(self) -> None:
        """Allow more time: the order was begun in time, and its first queries to the controller may take a while."""
        self._limit_s = CARRY_OUT_S

    def note_begun(self) -> None:
        """From now on only a stop or a change of control ends it: its first bytes have left."""
        self._limit_s = math.inf

    @property
    def has_control(self) -> bool:
        """Whether its giver still has control, and nobody has held or aborted the mill since. Time does not count."""
        gate, lease = self._gate, self._gate.get_lease()
        return gate._halts == self._grant.halts and lease is not None and lease.number == self._grant.lease

    def require(self) -> None:
        """Raise OrderRefusedError unless the order is still valid: the last check before a byte is sent."""
        gate, grant = self._gate, self._grant
        lease = gate.get_lease()
        if gate.stops != grant.stops:
            raise OrderRefusedError(Refusal.STOPPED, f"{self._doing}: not carried out: the mill was stopped since")
        age_s = gate._clock() - grant.issued_s
        if age_s > self._limit_s:
            raise OrderRefusedError(
                Refusal.EXPIRED, f"{self._doing}: not carried out: it was given {age_s:.1f} s ago; give it again"
            )
        if grant.lease != (None if lease is None else lease.number):
            raise OrderRefusedError(
                Refusal.LEASE, f"{self._doing}: not carried out: control has changed hands since", lease
            )
        if self._needs_lease and lease is None:
            raise OrderRefusedError(Refusal.NOBODY, f"{self._doing}: nobody has control: take control first")


@dataclass(frozen=True, slots=True)
class Order:
    """The order being carried out, and its caller; without a permit if nobody gave it as an order."""

    caller: Caller = NOBODY
    permit: Permit | None = None

    @property
    def has_control(self) -> bool:
        return self.permit is None or self.permit.has_control

    def extend(self) -> None:
        if self.permit is not None:
            self.permit.extend()

    def note_begun(self) -> None:
        if self.permit is not None:
            self.permit.note_begun()

    def require(self) -> None:
        if self.permit is not None:
            self.permit.require()


def _make_held_error(lease: Lease, *, lost: bool = False) -> OrderRefusedError:
    begin = "you have lost control: " if lost else ""
    since = time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime(lease.since_s))
    words = f"{begin}{lease.operator} has had control since {since}; ask them, or take over"
    return OrderRefusedError(Refusal.HELD, words, lease)


def _is_secret_of(lease: Lease, shown: str) -> bool:
    return hmac.compare_digest(lease.digest, _digest(shown))


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
