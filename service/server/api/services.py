"""The services that the routes use, at `app.state.services`: made once by main.py, and by tests."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from sqlalchemy import Engine
    from starlette.requests import HTTPConnection

    from service.server.api.access.stop_access import StopAccess
    from service.server.api.event_feed import Feed
    from service.server.api.intake.child_requests import Estimator, PictureChecker
    from service.server.api.monitoring import Metrics, Readiness
    from service.server.database.jobs import JobBook
    from service.server.database.pairing import PairingBook
    from service.server.database.tokens import TokenBook
    from service.server.fleet.fleet import Fleet
    from service.server.pairing_code import CodeOnTerminal
    from service.server.queue.engine import JobEngine
    from service.server.stop_socket import StopSockets
    from service.settings import ServerSettings
    from service.store.base import Store


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
    stop_sockets: StopSockets
    terminal: CodeOnTerminal
    fleet: Fleet
    pictures: PictureChecker
    estimates: Estimator
    exact_estimates: Estimator
    looks: Estimator  # at photographs: evaluates them in a child process
    feed: Feed
    metrics: Metrics
    readiness: Readiness
    # So many pictures are checked or wait for it at once: the others wait without a thread, which downloads need.
    accepting: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(8))


def services_of(connection: HTTPConnection) -> Services:
    return cast("Services", connection.app.state.services)
