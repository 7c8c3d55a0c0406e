"""Codes that a person types into the page to run mills from it. A code is good for a day and any number of pages.

Only a salted scrypt digest of its sixty random bits is stored, so that a stolen database gives no access. A graphics
card computes some 20,000 of these digests (8 MB each) in a second. An attacker with fifty of them, 10^6 a second, would
try 8.6 10^10 codes in the day that one lives: 1 chance in 13 million that it is among them, and 36,000 years for them
all.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import re
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, delete, select, update

from phrases.phrase import Phrase
from service.server.database.connection import begin_reading, begin_writing, insert_new
from service.server.database.tables import pairing_tries, pairings
from service.server.database.tokens import PAGE_TOKEN_LIFE_S, Token, TokenBook, TokenScope
from service.server.pairing_code import ALPHABET, read_code

CODE_LIFE_S = 86400.0
_MOST_CODES = 4
SCOPES = (TokenScope.JOBS_READ, TokenScope.JOBS_WRITE, TokenScope.MACHINE_RUN)
_OFFER = re.compile(rf"([0-9a-f]{{32}}):((?:[{ALPHABET}]{{4}}-){{2}}[{ALPHABET}]{{4}})")


class WrongCodeError(Exception):
    """The code is wrong. `left`: number of tries left now."""

    def __init__(self, left: int) -> None:
        if left > 1:
            words = Phrase("this is not the code; {count} more tries at once", count=left)
        elif left:
            words = Phrase("this is not the code; 1 more try at once")
        else:
            words = Phrase("this is not the code; the next try is in a minute")
        super().__init__(words)
        self.left = left


class NoCodeError(Exception):
    """Codes expire after a day, and no other one was made."""

    def __init__(self) -> None:
        super().__init__(
            Phrase(
                "no code is valid; make one on the server's computer: `causticmill token pair --data DIR` (DIR: "
                "the folder given to `serve`)"
            )
        )


class PairingBook:
    """The codes of one database; may be used from any thread and any process."""

    def __init__(self, engine: Engine, tokens: TokenBook, *, clock: Callable[[], float] = time.time) -> None:
        self._engine = engine
        self._tokens = tokens
        self._clock = clock

    def offer(self, offer: str) -> None:
        """Accept the code of an offer from now on, for a day. A known offer stays as it is."""
        found = _OFFER.fullmatch(offer)
        if found is None:
            raise ValueError("an offer is a text of codes.new_offer")
        now, salt = self._clock(), secrets.token_hex(16)
        row = {"id": found[1], "salt": salt, "digest": _digest(found[2], salt)}
        newest = select(pairings.c.id).order_by(pairings.c.created_at.desc()).limit(_MOST_CODES - 1)
        with begin_writing(self._engine) as connection:
            kept = [found[1], *connection.execute(newest).scalars()]
            connection.execute(delete(pairings).where((pairings.c.expires_at < now) | pairings.c.id.not_in(kept)))
            insert_new(connection, pairings, row | {"created_at": now, "expires_at": now + CODE_LIFE_S})

    def pair(self, code: str, person: str, *, address: str, counts_for_all: bool = True) -> tuple[Token, str]:
        """Create a token for the page of a person who knows a code, and its secret.

        address : by which the try is counted; counts_for_all: it also counts in the budget of all addresses
        WrongCodeError, NoCodeError; TooManyTriesError: the code was not checked.
        """
        alive = self._find_live()
        if not alive:
            raise NoCodeError
        with begin_writing(self._engine) as connection:
            take_try(connection, address, self._clock(), counts_for_all=counts_for_all)
        right = [hmac.compare_digest(_digest(read_code(code), row["salt"]), row["digest"]) for row in alive]
        with begin_writing(self._engine) as connection:
            if not any(right):
                raise WrongCodeError(tries_left(connection, address, self._clock()))
            give_back(connection, address, counts_for_all=counts_for_all)
        return self._tokens.create_paired(person, SCOPES, life_s=PAGE_TOKEN_LIFE_S)

    def is_live(self, offer: str) -> bool:
        """Return whether the code of this offer is still accepted."""
        return any(row["id"] == offer.partition(":")[0] for row in self._find_live())

    def _find_live(self) -> list[Any]:
        with begin_reading(self._engine) as connection:
            return list(connection.execute(select(pairings).where(pairings.c.expires_at > self._clock())).mappings())


def _digest(code: str, salt: str) -> str:
    return hashlib.scrypt(code.encode(), salt=salt.encode(), n=2**13, r=8, p=1, dklen=32).hex()


EVERYBODY = ""  # the row of all addresses


@dataclass(frozen=True, slots=True)
class Budget:
    """`most` tries at once, and one more every `refill_s`."""

    most: int
    refill_s: float


EACH, ALL = Budget(5, 60.0), Budget(200, 20.0)


class TooManyTriesError(Exception):
    """The try was not checked. everywhere: too many wrong codes come from all addresses, not only from here."""

    def __init__(self, wait_s: float, *, everywhere: bool) -> None:
        self.wait_s = max(1, math.ceil(wait_s))
        if everywhere:
            words = Phrase(
                "many wrong codes are being tried at this server; try again in {wait_s} s", wait_s=self.wait_s
            )
        else:
            words = Phrase("too many wrong codes from here; try again in {wait_s} s", wait_s=self.wait_s)
        super().__init__(words)


def take_try(connection: Connection, address: str, now: float, *, counts_for_all: bool) -> None:
    """Count a try before it is checked, so that simultaneous tries count too. TooManyTriesError."""
    connection.execute(
        delete(pairing_tries).where(
            pairing_tries.c.address != EVERYBODY, pairing_tries.c.at < now - EACH.most * EACH.refill_s
        )
    )
    budgets = [(address, EACH), (EVERYBODY, ALL)] if counts_for_all else [(address, EACH)]
    used = [_count_used(connection, name, budget, now) for name, budget in budgets]
    for (name, budget), spent in zip(budgets, used, strict=True):
        if spent + 1 > budget.most:
            raise TooManyTriesError((spent + 1 - budget.most) * budget.refill_s, everywhere=name == EVERYBODY)
    for (name, _), spent in zip(budgets, used, strict=True):
        connection.execute(update(pairing_tries).where(pairing_tries.c.address == name).values(used=spent + 1, at=now))


def give_back(connection: Connection, address: str, *, counts_for_all: bool) -> None:
    """Give back a try, because its code was right."""
    names = [address, EVERYBODY] if counts_for_all else [address]
    connection.execute(
        update(pairing_tries).where(pairing_tries.c.address.in_(names)).values(used=pairing_tries.c.used - 1)
    )


def tries_left(connection: Connection, address: str, now: float) -> int:
    """Return the tries left to this address, at once."""
    return max(0, math.floor(EACH.most - _count_used(connection, address, EACH, now) + 1e-9))


def _count_used(connection: Connection, address: str, budget: Budget, now: float) -> float:
    """Return tries of a budget that have not expired yet, and lock its row for this transaction."""
    insert_new(connection, pairing_tries, {"address": address, "used": 0.0, "at": now})
    used, at = connection.execute(
        select(pairing_tries.c.used, pairing_tries.c.at).where(pairing_tries.c.address == address).with_for_update()
    ).one()
    return max(0.0, float(used) - max(0.0, now - float(at)) / budget.refill_s)
