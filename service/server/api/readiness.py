"""Whether everything that the server needs works, each part by its own word."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable
from functools import partial

import sqlalchemy as sa
import structlog

from phrases.phrase import Phrase
from service.server.api.intake.disk_space import too_little_space
from service.server.api.shared_call import SharedCall
from service.server.database.connection import begin_reading, begin_writing, clock, put_rows
from service.server.database.tables import executors, idempotency_keys
from service.settings import ServerSettings
from service.store.base import Store

_WAIT_S = 5.0
_log = structlog.get_logger("api")


class _WrongError(Exception):
    """What is wrong, in words that may be shown."""


class Readiness:
    """One for the whole server: whoever asks while a part is being checked gets the answer of that check."""

    def __init__(self, settings: ServerSettings, database: sa.Engine, store: Store) -> None:
        self._settings = settings
        self._engine = database
        self._artifacts = store
        parts = {
            "database": self._check_database,
            "store": self._store,
            "worker": self._check_worker,
            "disk": self._check_disk,
        }
        self._checks = {name: SharedCall(partial(_check, name, check)) for name, check in parts.items()}

    async def checks(self) -> dict[str, str]:
        """Return `ok` or what is wrong for each part; none of them waits for another."""
        words = await asyncio.gather(*map(_answer, self._checks.values()))
        return dict(zip(self._checks, words, strict=True))

    def _check_database(self) -> None:
        with begin_writing(self._engine) as connection:
            row = {"principal": "", "kind": "ready", "key": "", "request_sha256": "", "resource_id": ""}
            put_rows(connection, idempotency_keys, [row | {"created_at": clock(connection)}])

    def _store(self) -> None:
        self._artifacts.check()

    def _check_worker(self) -> None:
        lease_s = self._settings.lease_s
        with begin_reading(self._engine) as connection:
            live = executors.c.seen_at > clock(connection) - lease_s
            if not connection.execute(sa.select(sa.func.count()).where(live)).scalar_one():
                raise _WrongError(Phrase("no worker has reported for {lease_s:g} s; jobs are waiting", lease_s=lease_s))

    def _check_disk(self) -> None:
        settings = self._settings
        free_mb = shutil.disk_usage(settings.data).free / 1e6
        if free_mb < settings.free_disk_mb:
            raise _WrongError(too_little_space(free_mb, settings.free_disk_mb))


def _check(name: str, check: Callable[[], None]) -> str:
    """Check one part. The true reason goes to the log; it may hold paths."""
    try:
        check()
    except _WrongError as error:
        return str(error)
    except Exception as error:
        _log.warning("not ready", part=name, error=" ".join(str(error).split())[:300])
        return Phrase("cannot be used at present")
    return "ok"


async def _answer(check: SharedCall[str]) -> str:
    try:
        return await check.result(_WAIT_S)
    except TimeoutError:
        return Phrase("no answer in {wait_s:g} s", wait_s=_WAIT_S)
