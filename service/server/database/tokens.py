"""Tokens with scopes: who may do what. Only a token's SHA-256 is stored, so a stolen database gives no access.

The secret is 256 random bits, so its hash needs no salt and no slow function, and can be looked up by value.
"""

from __future__ import annotations

import hmac
import itertools
import re
import secrets
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sqlalchemy import Connection, Engine, RowMapping, delete, func, insert, inspect, select, update

from phrases.phrase import Phrase
from service.errors import InputError
from service.server.database.connection import begin_reading, begin_writing
from service.server.database.tables import pairings, tokens
from service.server.stoppers import hash_secret

PREFIX = "cm_"  # so that people and secret scanners know one when they see it
_SECRET = re.compile(r"cm_[A-Za-z0-9_-]{43}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._@-]{0,79}")
_USE_NOTED_EVERY_S = 60.0
_ENDED_KEPT_S = 14 * 86400.0
PAGE_TOKEN_LIFE_S = 86400.0  # of the token that the page gets for a code; a run renews it
LONGEST_LIFE_S = 100 * 365 * 86400.0


class TokenScope(StrEnum):
    """The scopes of tokens. None of them includes another."""

    JOBS_READ = "jobs:read"
    JOBS_WRITE = "jobs:write"
    MACHINE_RUN = "machine:run"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """A token's record; times are seconds since 1970, None = never. paired: made with a code, by a page."""

    id: str
    name: str
    scopes: frozenset[str]
    created_at: float
    expires_at: float | None = None
    last_used_at: float | None = None
    revoked_at: float | None = None
    paired: bool = False

    def live(self, now: float) -> bool:
        return self.revoked_at is None and (self.expires_at is None or now < self.expires_at)


class TokenBook:
    """The tokens of one database; may be used from any thread and any process."""

    def __init__(self, engine: Engine, *, clock: Callable[[], float] = time.time) -> None:
        self.engine = engine
        self._clock = clock
        self._noted: dict[str, float] = {}

    def create(self, name: str, scopes: Iterable[str], *, expires_at: float | None = None) -> tuple[Token, str]:
        """Create a token and return its secret, which is not stored and never shown again. InputError if it is not
        allowed.
        """
        now = self._clock()
        wanted = check_scopes(scopes)
        if not _NAME.fullmatch(name):
            raise InputError(
                Phrase(
                    "name '{name}': allowed: 1 to 80 letters, digits, spaces and . _ @ -, a letter first",
                    name=name[:80],
                )
            )
        if expires_at is not None and not now < expires_at <= now + LONGEST_LIFE_S:
            raise InputError(Phrase("expires: allowed: a time from now on, within a hundred years"))
        token = Token(id=_new_id(), name=name, scopes=wanted, created_at=now, expires_at=expires_at)
        with begin_writing(self.engine) as connection:
            if name in _list_live_names(connection, now):
                raise InputError(
                    Phrase(
                        "name '{name}': there is a token of this name; revoke that one or take another name", name=name
                    )
                )
            return token, _insert(connection, token)

    def create_paired(self, person: str, scopes: Iterable[str], *, life_s: float) -> tuple[Token, str]:
        """Create a token for a person's page, under their name, with a number added if the name is taken.

        Such tokens do not count in `any_ever`. Tokens that expired long ago are deleted, because a page makes one with
        each visit; one that has just expired may still stop a mill.
        """
        now, wanted = self._clock(), check_scopes(scopes)
        with begin_writing(self.engine) as connection:
            connection.execute(delete(tokens).where(tokens.c.paired, tokens.c.expires_at < now - _ENDED_KEPT_S))
            taken = _list_live_names(connection, now)
            names = itertools.chain([person], (f"{person} {number}" for number in itertools.count(2)))
            name = next(name for name in names if name not in taken)
            token = Token(id=_new_id(), name=name, scopes=wanted, created_at=now, expires_at=now + life_s, paired=True)
            return token, _insert(connection, token)

    def list_rows(self) -> list[Token]:
        """List all tokens ever made, oldest first."""
        with begin_reading(self.engine) as connection:
            return [_token(row) for row in connection.execute(_ALL).mappings()]

    def revoke(self, token_id: str) -> Token:
        """Revoke a token: it gives no access any more. LookupError if there is none; revoking twice changes nothing."""
        with begin_writing(self.engine) as connection:
            mine = tokens.c.id == token_id
            connection.execute(
                update(tokens).where(mine, tokens.c.revoked_at.is_(None)).values(revoked_at=self._clock())
            )
            row = connection.execute(select(tokens).where(mine)).mappings().first()
        if row is None:
            raise LookupError(Phrase("no token has the id '{token_id}'", token_id=token_id[:40]))
        return _token(row)

    def revoke_all(self) -> int:
        """Revoke every token and forget every code; return how many tokens were live. The tables may be of an older
        version.
        """
        now = self._clock()
        with begin_writing(self.engine) as connection:
            there = set(inspect(connection).get_table_names())
            if pairings.name in there:
                connection.execute(delete(pairings))
            if tokens.name not in there:
                return 0
            live = tokens.c.revoked_at.is_(None) & (tokens.c.expires_at.is_(None) | (tokens.c.expires_at > now))
            count = connection.execute(select(func.count()).where(live)).scalar_one()
            connection.execute(update(tokens).where(tokens.c.revoked_at.is_(None)).values(revoked_at=now))
            return int(count)

    def find(self, secret: str) -> Token | None:
        """Return the live token with this secret; None if there is none."""
        if not _SECRET.fullmatch(secret):
            return None
        now, digest = self._clock(), hash_secret(secret)
        with begin_reading(self.engine) as connection:
            row = connection.execute(select(tokens).where(tokens.c.sha256 == digest)).mappings().first()
        if row is None or not hmac.compare_digest(str(row["sha256"]), digest):
            return None
        token = _token(row)
        return token if token.live(now) else None

    def find_unrevoked(self) -> dict[str, Token]:
        """Return every token that was not revoked, including expired ones, by the hash of its secret."""
        with begin_reading(self.engine) as connection:
            rows = connection.execute(select(tokens).where(tokens.c.revoked_at.is_(None))).mappings()
            return {str(row["sha256"]): _token(row) for row in rows}

    def note_use(self, token: Token, *, renew_s: float | None = None) -> None:
        """Record that a token is in use, at most once a minute; renew_s: new lifetime of a paired one."""
        now = self._clock()
        noted = self._noted.get(token.id, token.last_used_at)
        if noted is not None and now < noted + _USE_NOTED_EVERY_S:
            return
        self._noted[token.id] = now
        with begin_writing(self.engine) as connection:
            values = {"last_used_at": now}
            if token.paired and renew_s is not None and token.expires_at is not None:
                values["expires_at"] = max(token.expires_at, now + renew_s)
            alive = tokens.c.expires_at.is_(None) | (tokens.c.expires_at > now)
            connection.execute(update(tokens).where(tokens.c.id == token.id, alive).values(**values))

    def has_ever_had_any(self) -> bool:
        """Return whether there ever was a token. From the first one on no caller is anonymous: an expiry must not
        reopen access.

        Tokens of paired pages do not count: a person who runs mills from the page does not intend to close access to
        jobs.
        """
        with begin_reading(self.engine) as connection:
            return connection.execute(select(tokens.c.id).where(~tokens.c.paired).limit(1)).first() is not None

    def has_live(self) -> bool:
        """Return whether a token that an administrator has made is live."""
        now = self._clock()
        return any(token.live(now) and not token.paired for token in self.list_rows())


_ALL = select(tokens).order_by(tokens.c.created_at, tokens.c.id)


def check_scopes(scopes: Iterable[str]) -> frozenset[str]:
    """Check that there is at least one scope and all are known; InputError names an unknown one."""
    wanted = frozenset(scopes)
    allowed = ", ".join(TokenScope)
    if unknown := sorted(wanted - set(TokenScope)):
        raise InputError(Phrase("scope '{name}'; allowed: {allowed}", name=unknown[0][:40], allowed=allowed))
    if not wanted:
        raise InputError(Phrase("scope: at least one is needed; allowed: {allowed}", allowed=allowed))
    return frozenset(str(TokenScope(word)) for word in wanted)


def _list_live_names(connection: Connection, now: float) -> frozenset[str]:
    return frozenset(found.name for found in map(_token, connection.execute(_ALL).mappings()) if found.live(now))


def _insert(connection: Connection, token: Token) -> str:
    """Return the new token's secret."""
    secret = PREFIX + secrets.token_urlsafe(32)
    given = {name: getattr(token, name) for name in ("id", "name", "created_at", "expires_at", "paired")}
    connection.execute(insert(tokens).values(**given, sha256=hash_secret(secret), scopes=sorted(token.scopes)))
    return secret


def _new_id() -> str:
    return uuid.uuid4().hex[:12]


def _token(row: RowMapping) -> Token:
    values: dict[str, Any] = {name: row[name] for name in Token.__slots__ if name != "scopes"}
    return Token(**values, scopes=frozenset(row["scopes"]))
