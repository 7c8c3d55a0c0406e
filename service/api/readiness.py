"""Whether everything that the server needs works, each part by its own word."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable

import sqlalchemy as sa
import structlog

from service.api.services import Services
from service.jobs.database import clock, put_rows, reading, writing
from service.jobs.tables import executors, idempotency_keys

_WAIT_S = 5.0
_log = structlog.get_logger("api")


class _WrongError(Exception):
    """What is wrong, in words that may be shown."""


class Readiness:
    def __init__(self, services: Services) -> None:
        self._services = services

    async def checks(self) -> dict[str, str]:
        """`ok` or what is wrong, for each part; none of them waits for another."""
        parts = {"database": self._database, "store": self._store, "worker": self._worker, "disk": self._disk}
        words = await asyncio.gather(*(_told(name, check) for name, check in parts.items()))
        return dict(zip(parts, words, strict=True))

    def _database(self) -> None:
        with writing(self._services.database) as connection:
            row = {"principal": "", "kind": "ready", "key": "", "request_sha256": "", "resource_id": ""}
            put_rows(connection, idempotency_keys, [row | {"created_at": clock(connection)}])

    def _store(self) -> None:
        self._services.store.check()

    def _worker(self) -> None:
        lease_s = self._services.settings.lease_s
        with reading(self._services.database) as connection:
            live = executors.c.seen_at > clock(connection) - lease_s
            if not connection.execute(sa.select(sa.func.count()).where(live)).scalar_one():
                raise _WrongError(f"no worker was heard of for {lease_s:g} s; jobs wait")

    def _disk(self) -> None:
        settings = self._services.settings
        free_mb = shutil.disk_usage(settings.data).free / 1e6
        if free_mb < settings.free_disk_mb:
            raise _WrongError(f"{free_mb:.0f} MB are free; new jobs need {settings.free_disk_mb} MB")


async def _told(name: str, check: Callable[[], None]) -> str:
    """The true reason goes to the log; it may hold paths."""
    try:
        await asyncio.wait_for(asyncio.to_thread(check), _WAIT_S)
    except TimeoutError:
        return f"no answer in {_WAIT_S:g} s"
    except _WrongError as error:
        return str(error)
    except Exception as error:
        _log.warning("not ready", part=name, error=" ".join(str(error).split())[:300])
        return "cannot be used at present"
    return "ok"
