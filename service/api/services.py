"""What the routes work with, at `app.state.services`: made once by main.py, and by tests."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from sqlalchemy import Engine
    from starlette.requests import HTTPConnection

    from service.api.estimating import Estimator
    from service.api.feed import Feed
    from service.api.metrics import Metrics
    from service.api.pictures import PictureChecker
    from service.api.readiness import Readiness
    from service.api.stop_access import StopAccess
    from service.api.terminal import CodeOnTerminal
    from service.fleet.fleet import Fleet
    from service.jobs.book import JobBook
    from service.jobs.pairing import PairingBook
    from service.jobs.tokens import TokenBook
    from service.settings import ServerSettings
    from service.store.store import Store
    from service.worker.engine import JobEngine


@dataclass(frozen=True, slots=True, kw_only=True)
class Services:
    settings: ServerSettings
    database: Engine
    book: JobBook
    store: Store
    engine: JobEngine
    tokens: TokenBook
    pairings: PairingBook
    stop_access: StopAccess
    terminal: CodeOnTerminal
    fleet: Fleet
    pictures: PictureChecker
    estimates: Estimator
    exact_estimates: Estimator
    looks: Estimator  # at photographs
    feed: Feed
    metrics: Metrics
    readiness: Readiness
    # So many pictures are checked or wait for it at once: the others wait without a thread, which downloads need.
    accepting: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(8))


def services_of(connection: HTTPConnection) -> Services:
    return cast("Services", connection.app.state.services)
