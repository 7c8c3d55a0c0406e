"""Codes that a person types into the page to run mills from it: short, so every wrong try counts.

A code is good for a day and any number of pages. What is kept of it is a slow, salted digest, so that a stolen
database opens nothing. A wrong try counts against every code that lives, in the database, so that neither a restart nor
a second server gives more of them; a code with too many is dead, and a person at the server makes a new one.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
from collections.abc import Callable
from typing import Any

from sqlalchemy import Engine, delete, select, update

from service.jobs.database import insert_new, reading, writing
from service.jobs.tables import pairings
from service.jobs.tokens import Token, TokenBook, TokenScope

MOST_WRONG = 5
CODE_LIFE_S = 86400.0
TOKEN_LIFE_S = 86400.0
_MOST_CODES = 4
SCOPES = (TokenScope.JOBS_READ, TokenScope.JOBS_WRITE, TokenScope.MACHINE_RUN)
_OFFER = re.compile(r"([0-9a-f]{32}):(\d{4}-\d{4})")


class WrongCodeError(Exception):
    """This code opens nothing. `left`: tries that are left; 0: only a new code helps."""

    def __init__(self, left: int) -> None:
        if left:
            words = f"this is not the code; {left} {'tries' if left > 1 else 'try'} left"
        else:
            words = (
                "no code is valid any more; a new one, on the server's computer: `causticmill token pair --data DIR` "
                "(DIR: the folder that `serve` was given)"
            )
        super().__init__(words)
        self.left = left


class PairingBook:
    """The codes of one database; may be used from any thread and any process."""

    def __init__(self, engine: Engine, tokens: TokenBook, *, clock: Callable[[], float] = time.time) -> None:
        self._engine = engine
        self._tokens = tokens
        self._clock = clock

    def offer(self, offer: str) -> None:
        """From now on its code is taken. One that was offered before stays as it is, wrong tries included."""
        found = _OFFER.fullmatch(offer)
        if found is None:
            raise ValueError("an offer is a text of codes.new_offer")
        now, salt = self._clock(), secrets.token_hex(16)
        row = {"id": found[1], "salt": salt, "digest": _digest(found[2], salt), "wrong": 0}
        newest = select(pairings.c.id).order_by(pairings.c.created_at.desc()).limit(_MOST_CODES - 1)
        with writing(self._engine) as connection:
            kept = [found[1], *connection.execute(newest).scalars()]
            connection.execute(delete(pairings).where((pairings.c.expires_at < now) | pairings.c.id.not_in(kept)))
            insert_new(connection, pairings, row | {"created_at": now, "expires_at": now + CODE_LIFE_S})

    def pair(self, code: str, person: str) -> tuple[Token, str]:
        """A token for the page of a person who knows a code, and its secret. WrongCodeError."""
        rows = self._live()
        typed = re.sub(r"[\s-]", "", code)
        plain = f"{typed[:4]}-{typed[4:]}"
        tried = [(row["id"], hmac.compare_digest(_digest(plain, row["salt"]), row["digest"])) for row in rows]
        if not self._counted([identity for identity, _ in tried], right={one for one, right in tried if right}):
            raise WrongCodeError(MOST_WRONG - min((row["wrong"] for row in self._live()), default=MOST_WRONG))
        return self._tokens.create_paired(person, SCOPES, life_s=TOKEN_LIFE_S)

    def _live(self) -> list[Any]:
        alive = (pairings.c.wrong < MOST_WRONG) & (pairings.c.expires_at > self._clock())
        with reading(self._engine) as connection:
            return list(connection.execute(select(pairings).where(alive)).mappings())

    def _counted(self, tried: list[str], *, right: set[str]) -> bool:
        """Count a wrong try; True where a code was right and is not dead by now, by tries that came meanwhile."""
        with writing(self._engine) as connection:
            alive = select(pairings.c.id).where(pairings.c.id.in_(right), pairings.c.wrong < MOST_WRONG)
            if connection.execute(alive).first() is not None:
                return True
            connection.execute(update(pairings).where(pairings.c.id.in_(tried)).values(wrong=pairings.c.wrong + 1))
            return False


def _digest(code: str, salt: str) -> str:
    return hashlib.scrypt(code.encode(), salt=salt.encode(), n=2**13, r=8, p=1, dklen=32).hex()
