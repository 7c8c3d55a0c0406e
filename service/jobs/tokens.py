"""Who may do what: tokens with scopes. Only a token's SHA-256 is kept, so a stolen database opens nothing.

The secret is 256 random bits, so its hash needs no salt and no slow function, and may be looked up by value.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sqlalchemy import Engine, RowMapping, insert, select, update

from service.errors import InputError
from service.jobs.database import reading, writing
from service.jobs.tables import tokens

PREFIX = "cm_"  # so that people and secret scanners know one when they see it
_SECRET = re.compile(r"cm_[A-Za-z0-9_-]{43}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._@-]{0,79}")
_USE_NOTED_EVERY_S = 60.0
LONGEST_LIFE_S = 100 * 365 * 86400.0


class TokenScope(StrEnum):
    """What a token may be good for. None of them contains another."""

    JOBS_READ = "jobs:read"
    JOBS_WRITE = "jobs:write"
    MACHINE_RUN = "machine:run"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """What is known of a token; times are seconds since 1970, None = never."""

    id: str
    name: str
    scopes: frozenset[str]
    created_at: float
    expires_at: float | None = None
    last_used_at: float | None = None
    revoked_at: float | None = None

    def live(self, now: float) -> bool:
        return self.revoked_at is None and (self.expires_at is None or now < self.expires_at)


class TokenBook:
    """The tokens of one database; may be used from any thread and any process."""

    def __init__(self, engine: Engine, *, clock: Callable[[], float] = time.time) -> None:
        self._engine = engine
        self._clock = clock
        self._noted: dict[str, float] = {}

    def create(self, name: str, scopes: Iterable[str], *, expires_at: float | None = None) -> tuple[Token, str]:
        """A new token and its secret, which is nowhere else and never shown again. InputError where it cannot be."""
        now = self._clock()
        wanted = checked_scopes(scopes)
        if not _NAME.fullmatch(name):
            raise InputError(
                f"name '{name[:80]}': allowed: 1 to 80 letters, digits, spaces and . _ @ -, a letter first"
            )
        if expires_at is not None and not now < expires_at <= now + LONGEST_LIFE_S:
            raise InputError("expires: allowed: a time from now on, within a hundred years")
        secret = PREFIX + secrets.token_urlsafe(32)
        token = Token(id=uuid.uuid4().hex[:12], name=name, scopes=wanted, created_at=now, expires_at=expires_at)
        with writing(self._engine) as connection:
            if any(
                found.name == name and found.live(now) for found in map(_token, connection.execute(_ALL).mappings())
            ):
                raise InputError(f"name '{name}': there is a token of this name; revoke that one or take another name")
            connection.execute(insert(tokens).values(
                id=token.id, name=name, sha256=_hash(secret), scopes=sorted(wanted), created_at=now,
                expires_at=expires_at))  # fmt: skip
        return token, secret

    def listed(self) -> list[Token]:
        """All that were ever made, oldest first."""
        with reading(self._engine) as connection:
            return [_token(row) for row in connection.execute(_ALL).mappings()]

    def revoke(self, token_id: str) -> Token:
        """From now on it opens nothing. LookupError where there is none; revoking twice changes nothing."""
        with writing(self._engine) as connection:
            mine = tokens.c.id == token_id
            connection.execute(
                update(tokens).where(mine, tokens.c.revoked_at.is_(None)).values(revoked_at=self._clock())
            )
            row = connection.execute(select(tokens).where(mine)).mappings().first()
        if row is None:
            raise LookupError(f"no token has the id '{token_id[:40]}'")
        return _token(row)

    def find(self, secret: str) -> Token | None:
        """The live token with this secret, if there is one."""
        if not _SECRET.fullmatch(secret):
            return None
        now, digest = self._clock(), _hash(secret)
        with reading(self._engine) as connection:
            row = connection.execute(select(tokens).where(tokens.c.sha256 == digest)).mappings().first()
        if row is None or not hmac.compare_digest(str(row["sha256"]), digest):
            return None
        token = _token(row)
        return token if token.live(now) else None

    def note_use(self, token: Token) -> None:
        """Write down that it is in use, at most once a minute."""
        now = self._clock()
        noted = self._noted.get(token.id, token.last_used_at)
        if noted is not None and now < noted + _USE_NOTED_EVERY_S:
            return
        self._noted[token.id] = now
        with writing(self._engine) as connection:
            connection.execute(update(tokens).where(tokens.c.id == token.id).values(last_used_at=now))

    def any_ever(self) -> bool:
        """Was there ever a token? From then on nobody is anonymous: an expiry must not open what was closed."""
        with reading(self._engine) as connection:
            return connection.execute(select(tokens.c.id).limit(1)).first() is not None

    def any_live(self) -> bool:
        now = self._clock()
        return any(token.live(now) for token in self.listed())


_ALL = select(tokens).order_by(tokens.c.created_at, tokens.c.id)


def checked_scopes(scopes: Iterable[str]) -> frozenset[str]:
    """The scopes, each a known word and at least one; InputError names the one that is not."""
    wanted = frozenset(scopes)
    allowed = ", ".join(TokenScope)
    if unknown := sorted(wanted - set(TokenScope)):
        raise InputError(f"scope '{unknown[0][:40]}'; allowed: {allowed}")
    if not wanted:
        raise InputError(f"scope: at least one is needed; allowed: {allowed}")
    return frozenset(str(TokenScope(word)) for word in wanted)


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode("ascii")).hexdigest()


def _token(row: RowMapping) -> Token:
    values: dict[str, Any] = {name: row[name] for name in Token.__slots__ if name != "scopes"}
    return Token(**values, scopes=frozenset(row["scopes"]))
