"""Figures for Prometheus: what the database knows is read there at each scrape, only requests are counted here."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

import prometheus_client
import sqlalchemy as sa
from prometheus_client import CollectorRegistry, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.server.api.shared_call import SharedCall
from service.server.database.connection import begin_reading, clock
from service.server.database.job_rows import ARTIFACT_BYTES, RECOVERIES, STAGE_RESULTS, Counter, read_counters
from service.server.database.jobs import count_jobs, find_oldest_queued_at
from service.server.database.states import StageState
from service.server.database.tables import executors, runs

_BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)
_WAIT_S = 10.0
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
        """Return the figures as text; those who ask at the same time get the same. TimeoutError."""
        return await self._text.result(_WAIT_S)


class JobFigures(Collector):
    """What the database knows, asked at each scrape; without a database, only that there is none."""

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
    """Yield stages of all jobs there ever were. A retried stage counts as often as it was tried."""
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
        route = getattr(scope.get("route"), "path", "none")  # never the address itself: there is no end to those
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._metrics.seconds.labels(method, route, str(status)).observe(seconds)
