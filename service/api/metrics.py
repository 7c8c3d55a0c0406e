"""Figures for Prometheus: what the database knows is counted there at each scrape, only requests are counted here."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import sqlalchemy as sa
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.jobs.database import clock, reading
from service.jobs.states import JobState, StageState
from service.jobs.tables import artifacts, executors, jobs, runs, stage_results, stage_runs

_BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)
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
        self.sent = Counter("causticmill_sent_bytes", "Bytes of answers", registry=self.registry)
        self.followers = Gauge("causticmill_followers", "Open event streams of jobs", registry=self.registry)
        self.registry.register(JobFigures(database))
        ProcessCollector(registry=self.registry)

    def text(self) -> bytes:
        return generate_latest(self.registry)


class JobFigures(Collector):
    """What the database knows, asked at each scrape; without a database, only that there is none."""

    def __init__(self, database: sa.Engine) -> None:
        self._database = database

    def describe(self) -> list[Any]:
        return []

    def collect(self) -> Iterator[GaugeMetricFamily]:
        try:
            with reading(self._database) as connection:
                found = [*_jobs(connection), *_stages(connection), *_rest(connection)]
        except SQLAlchemyError:
            found = []
        yield _single("causticmill_database_up", "1: the database answers", 1.0 if found else 0.0)
        yield from found


def _jobs(connection: sa.Connection) -> Iterator[GaugeMetricFamily]:
    states = GaugeMetricFamily("causticmill_jobs", "Jobs by state", labels=["state"])
    counted = {
        row[0]: row[1] for row in connection.execute(sa.select(jobs.c.state, sa.func.count()).group_by(jobs.c.state))
    }
    for state in JobState:
        states.add_metric([str(state)], counted.get(str(state), 0))
    yield states
    oldest = connection.execute(sa.select(sa.func.min(jobs.c.queued_at)).where(jobs.c.state == "queued")).scalar()
    age_s = 0.0 if oldest is None else max(0.0, clock(connection) - oldest)
    yield _single("causticmill_queue_age_seconds", "How long the oldest waiting job waits", age_s)


def _stages(connection: sa.Connection) -> Iterator[GaugeMetricFamily]:
    """Of the jobs that are kept. A retried stage counts as often as it was tried."""
    table = stage_runs.c
    seconds = sa.func.sum(table.ended_at - table.started_at)
    query = sa.select(table.stage, table.state, sa.func.count(), seconds).group_by(table.stage, table.state)
    count = GaugeMetricFamily("causticmill_stage_runs", "Tries of stages", labels=["stage", "state"])
    spent = GaugeMetricFamily("causticmill_stage_seconds", "Time in committed stages", labels=["stage"])
    interrupted = 0
    for stage, state, number, total in connection.execute(query):
        count.add_metric([stage, state], number)
        if state == StageState.COMMITTED:
            spent.add_metric([stage], total or 0.0)
        interrupted += number if state == StageState.INTERRUPTED else 0
    yield count
    yield spent
    yield _single("causticmill_interruptions", "Tries that a death or a lost lease cut short", interrupted)
    taken = sa.select(sa.func.coalesce(sa.func.sum(jobs.c.fence - jobs.c.attempt), 0)).where(
        jobs.c.fence > jobs.c.attempt
    )
    yield _single("causticmill_recoveries", "Claims of jobs beyond the first", connection.execute(taken).scalar_one())


def _rest(connection: sa.Connection) -> Iterator[GaugeMetricFamily]:
    files = sa.select(artifacts.c.sha256, artifacts.c.bytes).distinct().subquery()
    total = connection.execute(sa.select(sa.func.coalesce(sa.func.sum(files.c.bytes), 0))).scalar_one()
    yield _single("causticmill_artifact_bytes", "Bytes of all artifacts, each content once", float(total))
    kept = connection.execute(sa.select(sa.func.count()).select_from(stage_results)).scalar_one()
    yield _single("causticmill_stage_results", "Stages that other jobs may reuse", kept)
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


class Measured:
    """ASGI middleware: time until an answer begins, by route; bytes sent."""

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began = time.perf_counter()

        async def noted(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._note(scope, message["status"], time.perf_counter() - began)
            else:
                self._metrics.sent.inc(len(message.get("body", b"")))
            await send(message)

        await self._app(scope, receive, noted)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "none")  # never the address itself: there is no end to those
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._metrics.seconds.labels(method, route, str(status)).observe(seconds)
