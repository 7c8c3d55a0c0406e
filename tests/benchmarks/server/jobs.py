"""Every route, and a turn of every periodic loop, with a thousand jobs in the database, ten and a hundred thousand.

On SQLite, and on PostgreSQL where it is installed (BENCH_DATABASES chooses). The API is a process of its own on
loopback; no worker takes the jobs that wait. The store holds none of their files.
"""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import sqlalchemy as sa
import structlog
from PIL import Image

from service.server.database.connection import begin_writing, connect
from service.server.database.jobs import JobBook
from service.server.database.records import JobState
from service.server.database.schema import upgrade_schema
from service.server.database.tables import executors
from service.server.database.tokens import TokenBook
from service.server.queue.dbos import DbosEngine
from service.server.worker.reconcile import Reconciler
from service.server.worker.retention import Retention
from service.settings import ServerSettings
from service.store.local import LocalStore
from service.store.opening import open_store
from tests.benchmarks.server.rows import row, spread
from tests.benchmarks.server.sizes import times
from tests.benchmarks.timing import Figure
from tests.service.server.api.test_process import api_process
from tests.service.server.database.many_jobs import count_states, job_id, load, run_id, state_of
from tests.service.server.worker.postgres import missing, running_postgres

DATABASES = os.environ.get("BENCH_DATABASES", "sqlite,postgresql").split(",")
COUNTS = tuple(int(n) for n in os.environ.get("BENCH_JOBS", "1000,10000,100000").split(","))
_CALLS = times(100)
_BUDGET_MS = 100.0
_FOLLOWED = 500
_FILES = 5_000
Call = Callable[[], httpx.Response]


def figures() -> Iterator[Figure]:
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    for number in COUNTS:
        if "sqlite" in DATABASES:
            with tempfile.TemporaryDirectory() as folder:
                yield from _figures(ServerSettings(data=Path(folder) / "data"), number)
        if "postgresql" in DATABASES and not missing():
            with tempfile.TemporaryDirectory() as folder, running_postgres(durable=True) as server:
                data, store = Path(folder) / "data", (Path(folder) / "store").as_uri()
                shared = ServerSettings(data=data, database_url=server.url(), store_url=store, store_is_shared=True)
                for figure in _figures(shared, number):
                    yield replace(figure, name=f"PostgreSQL, {figure.name}")
    yield from _time_lists()


def _figures(settings: ServerSettings, number: int) -> Iterator[Figure]:
    data = settings.data
    data.mkdir()
    database = connect(settings.sqlalchemy_url)
    upgrade_schema(database)
    begun = time.perf_counter()
    load(database, number)
    if not settings.embedded:  # else what was loaded goes to the disk while routes that write are measured
        with database.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.exec_driver_sql("CHECKPOINT")
    yield row(f"{number:,} jobs: put into the database", time.perf_counter() - begun, "s", n=1)
    engine = DbosEngine(settings)
    engine.prepare()
    with begin_writing(database) as connection:
        worker = {"id": "worker", "host": "h", "pid": 1, "boot": "b", "version": "1", "started_at": 0.0}
        connection.execute(executors.insert().values(**worker, seen_at=time.time() + 1e6))
    _, token = TokenBook(database).create("bench", ["jobs:read", "jobs:write", "machine:run", "admin"])
    url, store = settings.database_url, str(settings.store_url)
    shared = {"database_url": url, "store_url": store, "store_is_shared": "true"} if url else {}
    with api_process(data, requests_per_s="1e6", jobs_per_min="1e6", **shared) as (process, client):
        client.headers["Authorization"] = f"Bearer {token}"
        for name, call in _routes(client, number).items():
            for _ in range(3):
                _require_good(call())
            before = _processor_s(process.pid)
            took = [_time_of(call) for _ in range(_CALLS)]
            note = f"processor of the API {1000 * (_processor_s(process.pid) - before) / _CALLS:.1f} ms"
            yield from spread(f"{number:,} jobs: {name}", took, most=_BUDGET_MS, note=note)
    yield from _loops(database, settings, engine, number)
    engine.close()
    database.dispose()


def _routes(client: httpx.Client, number: int) -> dict[str, Call]:
    """Those that ask the database, each in its dearest form."""
    ended = next(job for job in range(number // 2, number) if state_of(job) == "succeeded")
    waiting = next(job for job in range(number - 1, 0, -1) if state_of(job) == "queued")
    middle = {"cursor": job_id(ended)}
    looks: dict[str, tuple[str, dict[str, Any]]] = {
        "list, first page": ("/v1/jobs", {"limit": 50}),
        "list, 200 from the middle": ("/v1/jobs", {"limit": 200, **middle}),
        "list, queued": ("/v1/jobs", {"state": "queued"}),
        "list, succeeded, middle": ("/v1/jobs", {"state": "succeeded", **middle}),
        "list, three states, 200": ("/v1/jobs", {"state": ["failed", "cancelled", "succeeded"], "limit": 200}),
        "look at an ended job": (f"/v1/jobs/{job_id(ended)}", {}),
        "look at a queued job": (f"/v1/jobs/{job_id(waiting)}", {}),
        "its request": (f"/v1/jobs/{job_id(ended)}/request", {}),
        "its artifacts": (f"/v1/jobs/{job_id(ended)}/artifacts", {}),
        "runs, first page": ("/v1/runs", {}),
        "runs of a mill, middle": ("/v1/runs", {"machine": "alpha", "cursor": run_id(number // 2)}),
        "runs of a job": ("/v1/runs", {"job": job_id(ended)}),
        "a run": (f"/v1/runs/{run_id(number // 2)}", {}),
        "machines": ("/v1/machines", {}),
        "metrics": ("/metrics", {}),
        "readyz": ("/readyz", {}),
        "whoami": ("/v1/whoami", {}),
    }
    calls: dict[str, Call] = {
        name: lambda path=path, asked=asked: client.get(path, params=asked) for name, (path, asked) in looks.items()
    }
    shades, mine = count(), list[str]()

    def submit() -> httpx.Response:
        answer = client.post("/v1/jobs", files={"image": ("a.png", _picture(next(shades)))})
        mine.append(answer.json()["id"])
        return answer

    def each(verb: str) -> Call:
        turn = count()
        return lambda: client.post(f"/v1/jobs/{mine[next(turn)]}:{verb}")

    calls |= {"submit": submit, "cancel": each("cancel"), "retry": each("retry")}
    return calls | {"delete": lambda: client.delete(f"/v1/jobs/{mine.pop()}")}


def _loops(database: sa.Engine, settings: ServerSettings, engine: DbosEngine, number: int) -> Iterator[Figure]:
    """One turn each. The reconciler has handed the queue to the engine before."""
    reconciler = Reconciler(database, engine, executor="worker", lease_s=30.0, list_active=set)
    book, retention = JobBook(database), Retention(database, open_store(settings), engine, settings)
    followed = {job_id(job): 5 for job in range(min(number, _FOLLOWED))}
    yield row(
        f"{number:,} jobs: reconciler, first turn (200 of the queue submitted)", _s(reconciler.reconcile), "s", n=1
    )
    for _ in range(count_states(book)[JobState.QUEUED] // 200 + 2):
        reconciler.reconcile()
    turns = [_s(reconciler.reconcile) for _ in range(times(10))]
    yield from spread(f"{number:,} jobs: reconciler, a turn (each 3 s)", turns)
    yield row(f"{number:,} jobs: retention, first turn", _s(retention.clean_up), "s", n=1, note="the whole store")
    yield from spread(
        f"{number:,} jobs: retention, a turn (each 300 s)", [_s(retention.clean_up) for _ in range(times(5))]
    )
    polls = [_s(lambda: book.read_news(followed)) for _ in range(times(20))]
    yield from spread(f"{number:,} jobs: feed, a poll for {_FOLLOWED} idle followers (each 0.25 s)", polls)


def _time_lists() -> Iterator[Figure]:
    """What the sweep of a full store costs beyond the database: a turn looks at a sixteenth of the files."""
    with tempfile.TemporaryDirectory() as folder:
        store = LocalStore(Path(folder))
        for name in range(_FILES):
            part = Path(folder) / f"{name % 256:02x}"
            part.mkdir(exist_ok=True)
            (part / f"{name % 256:02x}{name:062x}").touch()
        took = _s(lambda: list(store.list()))
    yield row("sweep: a file of the store looked at", 1e6 * took / _FILES, "us", n=_FILES)


def _picture(shade: int) -> bytes:
    image, file = Image.new("L", (32, 32), shade % 256), BytesIO()
    image.putpixel((0, 0), shade // 256 % 256)
    image.save(file, "PNG")
    return file.getvalue()


def _require_good(answer: httpx.Response) -> None:
    assert answer.is_success, answer.text


def _time_of(call: Call) -> float:
    begun = time.perf_counter()
    answer = call()
    took = time.perf_counter() - begun
    _require_good(answer)
    return took


def _processor_s(pid: int) -> float:
    """What a process has used of the processors so far."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _s(action: Callable[[], object]) -> float:
    begun = time.perf_counter()
    action()
    return time.perf_counter() - begun
