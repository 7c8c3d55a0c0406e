"""How many codes may be tried: five at once from each address and then one a minute; and for all addresses together a
far larger budget, which only slows a crowd of guessers down. So nobody can shut others out by trying wrong ones.

Each budget is a row of the database that fills up with time: neither a restart nor a second server gives more. Whoever
tries wherever they can all day has 200 + 86400 / 20 tries: against four codes of sixty bits, 1 chance in 6 10^13. What
the budgets bound is the work that a try costs the server: a slow digest for each code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sqlalchemy import Connection, delete, select, update

from service.jobs.database import insert_new
from service.jobs.tables import pairing_tries as rows

EVERYBODY = ""  # the row of all addresses


@dataclass(frozen=True, slots=True)
class Budget:
    """`most` tries at once, and one more every `refill_s`."""

    most: int
    refill_s: float


EACH, ALL = Budget(5, 60.0), Budget(200, 20.0)


class TooManyTriesError(Exception):
    """This one was not looked at. everywhere: not from here alone, too many wrong codes come."""

    def __init__(self, wait_s: float, *, everywhere: bool) -> None:
        self.wait_s = max(1, math.ceil(wait_s))
        why = "many wrong codes are being tried at this server" if everywhere else "too many wrong codes from here"
        super().__init__(f"{why}; try again in {self.wait_s} s")


def take_try(connection: Connection, address: str, now: float, *, counts_for_all: bool) -> None:
    """Take a try before it is looked at, so that those that come at once are counted, too. TooManyTriesError."""
    connection.execute(delete(rows).where(rows.c.address != EVERYBODY, rows.c.at < now - EACH.most * EACH.refill_s))
    budgets = [(address, EACH), (EVERYBODY, ALL)] if counts_for_all else [(address, EACH)]
    used = [_used(connection, name, budget, now) for name, budget in budgets]
    for (name, budget), spent in zip(budgets, used, strict=True):
        if spent + 1 > budget.most:
            raise TooManyTriesError((spent + 1 - budget.most) * budget.refill_s, everywhere=name == EVERYBODY)
    for (name, _), spent in zip(budgets, used, strict=True):
        connection.execute(update(rows).where(rows.c.address == name).values(used=spent + 1, at=now))


def give_back(connection: Connection, address: str, *, counts_for_all: bool) -> None:
    """It was right."""
    names = [address, EVERYBODY] if counts_for_all else [address]
    connection.execute(update(rows).where(rows.c.address.in_(names)).values(used=rows.c.used - 1))


def tries_left(connection: Connection, address: str, now: float) -> int:
    """Of this address, at once."""
    return max(0, math.floor(EACH.most - _used(connection, address, EACH, now) + 1e-9))


def _used(connection: Connection, address: str, budget: Budget, now: float) -> float:
    """Tries of a budget that time has not given back yet; its row is this transaction's from now on."""
    insert_new(connection, rows, {"address": address, "used": 0.0, "at": now})
    used, at = connection.execute(
        select(rows.c.used, rows.c.at).where(rows.c.address == address).with_for_update()
    ).one()
    return max(0.0, float(used) - max(0.0, now - float(at)) / budget.refill_s)
