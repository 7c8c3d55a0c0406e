"""Who holds control of which mill: one person at a time, as long as their page shows that it is there.

In the database, so that neither a restart nor a second server makes two of one. The holder's secret is known to the
holder alone; what is kept is its hash.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from service.jobs.database import clock, put_rows, reading, writing
from service.jobs.tables import controls

LEASE_S = 60.0
_RENEWED_EVERY_S = 5.0  # by orders: a database need not write with each step of a jog


@dataclass(frozen=True, slots=True, kw_only=True)
class Lease:
    """Control of a mill as others may see it; since: seconds since 1970."""

    operator: str
    since: float


class HeldError(Exception):
    """Somebody else holds control."""

    def __init__(self, machine: str, lease: Lease) -> None:
        super().__init__(f"{lease.operator} has control of '{machine}'")
        self.lease = lease


class LeaseBook:
    """May be used from any thread and any process."""

    def __init__(self, database: sa.Engine) -> None:
        self._database = database

    def holder(self, machine: str) -> Lease | None:
        with reading(self._database) as connection:
            row = _live(connection, machine)
        return None if row is None else _lease(row)

    def take(
        self, machine: str, operator: str, principal: str, shown: str, *, take_over: bool
    ) -> tuple[str, Lease, bool]:
        """The secret, the lease, and whether it is new: a holder who shows the secret keeps it. HeldError."""
        with writing(self._database) as connection:
            now, row = clock(connection), _live(connection, machine)
            mine = row is not None and _is_of(row, shown)
            if row is not None and not mine and not take_over:
                raise HeldError(machine, _lease(row))
            secret = shown if mine else secrets.token_urlsafe(18)
            since = row["since"] if row is not None and mine else now
            new = {"machine": machine, "digest": _digest(secret), "operator": operator, "principal": principal}
            put_rows(connection, controls, [new | {"since": since, "renewed_at": now}])
        return secret, Lease(operator=operator, since=since), not mine

    def keep(self, machine: str, shown: str) -> bool:
        """True where this secret is the holder's, who is thereby known to be there."""
        with reading(self._database) as connection:
            row = _live(connection, machine)
            if row is None or not _is_of(row, shown):
                return False
            fresh = clock(connection) < row["renewed_at"] + _RENEWED_EVERY_S
        return fresh or self._renewed(machine, shown)

    def release(self, machine: str, shown: str) -> bool:
        """True where it was this holder's, and is nobody's now."""
        mine = sa.and_(controls.c.machine == machine, controls.c.digest == _digest(shown))
        with writing(self._database) as connection:
            row = _live(connection, machine)
            return row is not None and connection.execute(controls.delete().where(mine)).rowcount == 1

    def _renewed(self, machine: str, shown: str) -> bool:
        mine = sa.and_(controls.c.machine == machine, controls.c.digest == _digest(shown))
        with writing(self._database) as connection:
            values = {"renewed_at": clock(connection)}
            return connection.execute(controls.update().where(mine).values(**values)).rowcount == 1


def _live(connection: sa.Connection, machine: str) -> Any:
    """The machine's row, if its holder was there lately."""
    row = connection.execute(sa.select(controls).where(controls.c.machine == machine)).mappings().first()
    return row if row is not None and clock(connection) < row["renewed_at"] + LEASE_S else None


def _is_of(row: Any, shown: str) -> bool:
    return hmac.compare_digest(str(row["digest"]), _digest(shown))


def _lease(row: Any) -> Lease:
    return Lease(operator=row["operator"], since=row["since"])


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
