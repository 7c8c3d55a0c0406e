"""Monitoring of the server: whether each part that it needs works, and figures for Prometheus.

Figures of the database are read from it at each scrape; only requests are counted here.
"""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from functools import partial
from typing import Any, Generic, TypeVar

import prometheus_client
import sqlalchemy as sa
import structlog
from prometheus_client import CollectorRegistry, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from phrases.phrase import Phrase
from service.server.api.intake.form import too_little_space
from service.server.database.connection import begin_reading, begin_writing, clock, put_rows
from service.server.database.job_rows import ARTIFACT_BYTES, RECOVERIES, STAGE_RESULTS, Counter, read_counters
from service.server.database.jobs import count_jobs, find_oldest_queued_at
from service.server.database.records import StageState
from service.server.database.tables import executors, idempotency_keys, runs
from service.settings import ServerSettings
from service.store.base import Store

Result = TypeVar("Result")


class SharedCall(Generic[Result]):
    """Callers share the call under way. A call that hangs blocks a single thread, which no other work needs.

    For one event loop.
    """

    def __init__(self, call: Callable[[], Result]) -> None:
        self._call = call
        self._running: Future[Result] | None = None
        self._began_s = 0.0

    async def result(self, timeout_s: float) -> Result:
        """Return the result; TimeoutError if the call takes too long, at once if it already has."""
        if self._running is None or self._running.done():
            self._running, self._began_s = Future(), time.monotonic()
            # A daemon: a check that hangs does not keep the process from ending.
            threading.Thread(target=self._run, args=(self._running,), name="shared call", daemon=True).start()
        left_s = self._began_s + timeout_s - time.monotonic()
        if left_s <= 0 and not self._running.done():
            raise TimeoutError
        done = asyncio.wrap_future(self._running)
        await asyncio.wait({done}, timeout=max(0.0, left_s))  # does not cancel it: others wait for it too
        if not done.done():
            raise TimeoutError
        return done.result()

    def _run(self, running: Future[Result]) -> None:
        try:
            running.set_result(self._call())
        except BaseException as error:
            running.set_exception(error)


_WAIT_S = 5.0
_log = structlog.get_logger("api")


class _WrongError(Exception):
    """A fault, with a message that may be shown."""


class Readiness:
    """The readiness check of the whole server: a caller that asks while a part is being checked gets the result of that
    check.
    """

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
        """Return `ok` or the fault of each part; the checks do not wait for each other."""
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
    """Check one part. The true reason is only logged, because it may contain paths."""
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


_BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)
_FIGURES_WAIT_S = 10.0
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class Metrics:
    """The figures of this process, in a registry of its own."""

    def __init__(self, database: sa.Engine) -> None:
        self.registry = CollectorRegistry()
        self.seconds = Histogram(
            "causticmill_request_seconds",
            "Time until an answer began",
            ["method", "route", "status"],
            buckets=_BUCKETS,
            registry=self.registry,
        )
        self.sent = prometheus_client.Counter("causticmill_sent_bytes", "Bytes of answers", registry=self.registry)
        self.followers = Gauge("causticmill_followers", "Open event streams of jobs", registry=self.registry)
        self.registry.register(JobFigures(database))
        ProcessCollector(registry=self.registry)
        self._text = SharedCall(lambda: generate_latest(self.registry))

    async def text(self) -> bytes:
        """Return the figures as text; simultaneous callers get the same text. TimeoutError."""
        return await self._text.result(_FIGURES_WAIT_S)


class JobFigures(Collector):
    """Figures of the database, read at each scrape; without a database, only the fact that it is away."""

    def __init__(self, database: sa.Engine) -> None:
        self._database = database

    def describe(self) -> list[Any]:
        return []

    def collect(self) -> Iterator[GaugeMetricFamily]:
        try:
            with begin_reading(self._database) as connection:
                counted = read_counters(connection)
                found = [*_jobs(connection, counted), *_stages(counted), *_rest(connection)]
        except SQLAlchemyError:
            found = []
        yield _single("causticmill_database_up", "1: the database answers", 1.0 if found else 0.0)
        yield from found


def _jobs(connection: sa.Connection, counted: Mapping[Counter, float]) -> Iterator[GaugeMetricFamily]:
    states = GaugeMetricFamily("causticmill_jobs", "Jobs by state", labels=["state"])
    for state, number in count_jobs(counted).items():
        states.add_metric([str(state)], number)
    yield states
    now, oldest = clock(connection), find_oldest_queued_at(connection)
    age_s = 0.0 if oldest is None else max(0.0, now - oldest)
    yield _single("causticmill_queue_age_seconds", "How long the oldest waiting job waits", age_s)
    yield _single("causticmill_recoveries", "Claims of jobs beyond the first", counted.get(RECOVERIES, 0.0))


def _stages(counted: Mapping[Counter, float]) -> Iterator[GaugeMetricFamily]:
    """Yield figures of the stages of all jobs ever. A retried stage counts as often as it was tried."""
    count = GaugeMetricFamily("causticmill_stage_runs", "Tries of stages that have ended", labels=["stage", "state"])
    spent = GaugeMetricFamily("causticmill_stage_seconds", "Time in committed stages", labels=["stage"])
    interrupted = 0.0
    for counter, value in sorted(counted.items()):
        if counter.name == "stage_runs":
            count.add_metric([counter.stage, counter.state], value)
            interrupted += value if counter.state == StageState.INTERRUPTED else 0
        elif counter.name == "stage_seconds":
            spent.add_metric([counter.stage], value)
    yield count
    yield spent
    yield _single("causticmill_interruptions", "Tries that a death or a lost lease cut short", interrupted)
    yield _single("causticmill_stage_results", "Stages that other jobs may reuse", counted.get(STAGE_RESULTS, 0.0))
    words = "Bytes of all artifacts, each content once, as a worker counts them every few minutes"
    yield _single("causticmill_artifact_bytes", words, counted.get(ARTIFACT_BYTES, 0.0))


def _rest(connection: sa.Connection) -> Iterator[GaugeMetricFamily]:
    beats = GaugeMetricFamily(
        "causticmill_worker_beat_age_seconds", "Since a worker was last heard of", labels=["executor"]
    )
    now = clock(connection)
    for executor, seen_at in connection.execute(sa.select(executors.c.id, executors.c.seen_at)):
        beats.add_metric([executor], max(0.0, now - seen_at))
    yield beats
    open_runs = connection.execute(sa.select(sa.func.count()).where(runs.c.open)).scalar_one()
    yield _single("causticmill_open_runs", "Runs on mills that have not ended", open_runs)


def _single(name: str, words: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, words, value=value)


class MetricsMiddleware:
    """ASGI middleware: time until an answer begins, by route; bytes sent."""

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began = time.perf_counter()

        async def send_noted(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._note(scope, message["status"], time.perf_counter() - began)
            else:
                self._metrics.sent.inc(len(message.get("body", b"")))
            await send(message)

        await self._app(scope, receive, send_noted)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "none")  # never the address itself: there is no end of addresses
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._metrics.seconds.labels(method, route, str(status)).observe(seconds)
