"""No route and no periodic loop reads a large table from end to end: the plans of all their queries, on both databases.

What is sent is recorded while each route is called and each loop makes a turn, and then explained by the database.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import sqlalchemy as sa

from service.job.stages.order import FileRef, StageResult
from service.server.database.claims import StageClose, WorkBook
from service.server.database.connection import is_sqlite
from service.server.database.jobs import JobBook
from service.server.database.records import JobState, StageState
from service.server.database.schema import open_database
from service.server.database.tables import metadata
from service.server.fleet.fleet import Fleet
from service.server.queue.dbos import DbosEngine
from service.server.queue.engine import Ticket
from service.server.worker.reconcile import Reconciler
from service.server.worker.retention import DAY_S, Retention
from service.settings import ServerSettings
from service.store.opening import open_store
from tests.levels import DATABASES
from tests.service.server.api.server import api_server, png
from tests.service.server.database.many_jobs import EVERY_S, job_id, load, run_id, state_of

COUNT = 2000
SMALL = {"executors", "tokens", "pairings", "pairing_tries", "counters", "progress"}
LARGE = set(metadata.tables) - SMALL
_COUPON = "/v1/profiles/{profile}/coupon"
NO_QUERY = (
    "/v1/estimates",
    "/v1/profiles",
    "/v1/profiles/{profile}",
    "/v1/tools",
    f"{_COUPON}.zip",
    f"{_COUPON}/photos",
    "/",
    "/page/",
    "/livez",
    "/v1/whoami",
)
OTHERS_TABLES = ("/v1/tokens", "/v1/pairings")
# Orders to a mill, and streams about one, ask for a run by its id or for the one open run of the mill.
ORDERS = ("/v1/machines/{machine}/", "/v1/runs/{id:uuid}:", "/v1/runs/{id:uuid}/")


@pytest.fixture(scope="module", params=DATABASES)
def farm(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ServerSettings:
    """As the fixture of all tests, but one database for all of these: it takes a while to fill."""
    folder = tmp_path_factory.mktemp("plans")
    if request.param == "sqlite":
        return ServerSettings(data=folder / "data")
    url, store = request.getfixturevalue("postgres").url(), (folder / "store").as_uri()
    return ServerSettings(data=folder / "data", database_url=url, store_url=store, store_is_shared=True)


@pytest.fixture(scope="module")
def many(farm: ServerSettings) -> Iterator[sa.Engine]:
    opened = open_database(farm, migrate=True)
    load(opened, COUNT)
    yield opened
    opened.dispose()


def job_in(state: str, *, after: int = 0) -> str:
    return job_id(next(number for number in range(after, COUNT) if state_of(number) == state))


Query = tuple[str, Any]


@contextmanager
def recorded(database: sa.Engine) -> Iterator[list[Query]]:
    """Every statement that is sent meanwhile, with its parameters."""
    found: list[Query] = []

    def note(_c: object, _cursor: object, statement: str, parameters: Any, _context: object, many: bool) -> None:
        if not many and statement.split()[0] in ("SELECT", "UPDATE", "DELETE", "WITH"):
            found.append((statement, parameters))

    sa.event.listen(database, "before_cursor_execute", note)
    try:
        yield found
    finally:
        sa.event.remove(database, "before_cursor_execute", note)


def faults(database: sa.Engine, queries: list[Query]) -> list[str]:
    """What of them reads a large table from end to end."""
    explain = _sqlite_fault if is_sqlite(database) else _postgres_fault
    found = []
    with database.connect() as connection:
        for statement, parameters in dict(queries).items():
            if fault := explain(connection, statement, parameters):
                found.append(f"{fault}: {' '.join(statement.split())[:300]}")
    return found


def _sqlite_fault(connection: sa.Connection, statement: str, parameters: Any) -> str:
    plan = [row.detail for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", parameters)]
    ordered = "LIMIT" in statement and not any("TEMP B-TREE FOR ORDER BY" in line for line in plan)
    for line in plan:
        words = line.split()
        if words[0] == "SCAN" and words[1] in LARGE and "uq_runs_open_machine" not in line:
            first_page = ordered and "USING" in line and "WHERE" not in statement
            if not first_page:
                return line
    if "LIMIT" in statement and not ordered:
        return "sorts before its limit"
    return ""


def _postgres_fault(connection: sa.Connection, statement: str, parameters: Any) -> str:
    (plan,) = connection.exec_driver_sql(f"EXPLAIN (FORMAT JSON) {statement}", parameters).scalar_one()
    limited = "LIMIT" in statement
    for node in _nodes(plan["Plan"]):
        table = node.get("Relation Name")
        if node["Node Type"] == "Seq Scan" and table in LARGE:
            return f"Seq Scan on {table}"
        whole = "Index Cond" not in node and node.get("Index Name") not in (None, "uq_runs_open_machine")
        if whole and node["Node Type"].startswith("Index") and not limited:
            return f"whole {node['Index Name']}"
        if node["Node Type"] == "Sort" and limited and node["Plan Rows"] > COUNT / 10:
            return "sorts before its limit"
    return ""


def _nodes(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield node
    for inner in node.get("Plans", ()):
        yield from _nodes(inner)


def asked(server: Any) -> list[tuple[str, str]]:
    """Method and address of a call of each route, those with several forms more than once."""
    queued, running, ended = job_in("queued"), job_in("running"), job_in("succeeded", after=COUNT // 2)
    failed = [job_in("failed", after=100 * number) for number in range(1, 4)]
    cursor = f"cursor={ended}"
    states = "state=succeeded&state=failed&state=queued"
    lists = ("", cursor, "state=queued", f"state=succeeded&{cursor}", states, f"{states}&{cursor}&limit=20")
    jobs = [f"/v1/jobs?{query}" for query in lists]
    parts = ("", "/request", "/image", "/artifacts", "/artifacts/map.png", "/programs/1", "/archive.zip")
    gets = [*jobs, *(f"/v1/jobs/{job}{part}" for job in (queued, running, ended) for part in parts)]
    # A few runs a page: for fifty of so few rows a whole table is the cheaper way, and that is what is planned.
    middle = f"cursor={run_id(COUNT // 2)}"
    pages = ("", middle, "machine=alpha", f"job={ended}", f"machine=beta&{middle}")
    runs = [f"/v1/runs?limit=5&{query}" for query in pages]
    gets += [*runs, f"/v1/runs/{run_id(7)}", "/v1/machines", "/v1/machines/simulated", "/metrics", "/readyz"]
    heads = [f"/v1/jobs/{ended}{part}" for part in ("/artifacts", "/artifacts/map.png", "/programs/1", "/archive.zip")]
    posts = [f"/v1/jobs/{queued}:cancel", *(f"/v1/jobs/{job}:retry" for job in failed)]
    return [
        *(("GET", path) for path in gets),
        *(("HEAD", path) for path in heads),
        *(("POST", path) for path in posts),
        ("DELETE", f"/v1/jobs/{ended}"),
    ]


def test_no_route_reads_a_table_from_end_to_end(many: sa.Engine, farm: ServerSettings) -> None:
    given = {} if farm.embedded else {"database_url": str(farm.database_url), "store_url": farm.store_url}
    shared = {} if farm.embedded else {"store_is_shared": True}
    with api_server(farm.data, **given, **shared) as server:
        token = server.services.tokens.create("all", ["jobs:read", "jobs:write", "machine:run", "admin"])[1]
        server.client.headers["Authorization"] = f"Bearer {token}"
        with recorded(server.services.database) as queries:
            calls = asked(server)
            for method, path in calls:
                answer = server.client.request(method, path)
                assert answer.status_code < 500 or answer.status_code == 503, answer.text  # files that are not there
            headers = {"Idempotency-Key": "one"}
            answer = server.client.post("/v1/jobs", files={"image": png()}, headers=headers)
            assert answer.status_code == 202
            job = job_in("succeeded")
            server.client.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "5"})
            assert server.client.post(f"/v1/jobs/{job}/photos", files={"photo": png()}).status_code < 500
            body = {"job": job, "program": 1}
            server.client.post("/v1/machines/alpha/runs", json=body)
            server.services.book.read_news({job_id(number): 3 for number in range(20)})
        by_hand = [("POST", "/v1/jobs"), ("GET", f"/v1/jobs/{job}/events"), ("POST", f"/v1/jobs/{job}/photos")]
        assert_all_routes(server, [*calls, *by_hand])
        assert len(queries) > 100
        assert faults(server.services.database, queries) == []


def test_a_page_of_runs_takes_as_many_queries_for_a_hundred_as_for_two(many: sa.Engine, farm: ServerSettings) -> None:
    """The last page each time: the jobs of its last two runs have not ended, so that all there is to ask is asked."""

    async def count_queries(limit: int) -> int:
        fleet = Fleet(farm, many, open_store(farm), JobBook(many))
        with recorded(many) as queries:
            page = await fleet.list_runs(machine=None, job=None, limit=limit, before=run_id(limit))
        await fleet.aclose()
        assert [run.id for run in page] == [run_id(number) for number in reversed(range(limit))]
        assert all(run.setup for run in page)
        return len(queries)

    assert asyncio.run(count_queries(100)) == asyncio.run(count_queries(2)) <= 8


def assert_all_routes(server: Any, calls: list[tuple[str, str]]) -> None:
    """Every route was called, but those that the constants above name."""
    from service.server.api.app import _ROUTERS

    for route in (route for module in _ROUTERS for route in module.router.routes if hasattr(route, "methods")):
        path = route.path
        known = path in (*NO_QUERY, *OTHERS_TABLES) or path.startswith((*ORDERS, "/page/", "/v1/tokens"))
        called = any(
            method in route.methods and route.path_regex.match(address.partition("?")[0]) for method, address in calls
        )
        assert known or called, path


def test_no_periodic_loop_reads_a_table_from_end_to_end(many: sa.Engine, farm: ServerSettings) -> None:
    settings = farm.model_copy(update={"keep_days": (COUNT - 100) * EVERY_S / DAY_S, "quota_mb": 1})
    engine = DbosEngine(settings)
    engine.prepare()
    retention = Retention(many, open_store(settings), engine, settings)
    retention._named_bytes["00"] = 2_000_000  # over quota until the first jobs have gone
    reconciler = Reconciler(many, engine, executor="worker", lease_s=10.0, list_active=set)
    with recorded(many) as queries:
        retention.clean_up()
        for _ in range(3):
            reconciler.reconcile()
    assert len(queries) > 100
    assert faults(many, queries) == []


def test_no_step_of_a_worker_reads_a_table_from_end_to_end(many: sa.Engine) -> None:
    work, book = WorkBook(many, lease_s=10.0), JobBook(many)
    made = StageResult(outputs={"a.png": FileRef("a" * 64, 1)}, report={}, notes={}, seconds=1.0, peak_rss_mb=1.0)
    with recorded(many) as queries:
        claim = work.claim(Ticket(job_in("queued", after=COUNT // 2), 1), "here")
        assert claim is not None
        work.commit_stage(claim, work.begin_stage(claim, "image", "new"), made, log=None, whole=0.1)
        assert work.reuse_stage(claim, "image", "new", whole=0.1)
        work.end_stage(claim, work.begin_stage(claim, "map", "other"), StageClose(state=StageState.FAILED, words=""))
        work.note_progress(claim, "map", 0.5, whole=0.2)
        work.count_crashes(claim, "map")
        work.read_wishes([claim])
        work.find_result("new")
        work.forget_result("new")
        work.finish(claim, JobState.FAILED)
        book.delete(claim.job.id)
    assert faults(many, queries) == []


def test_a_list_does_not_carry_specs_and_reports(many: sa.Engine) -> None:
    with recorded(many) as queries:
        assert len(JobBook(many).list_rows(limit=200)) == 200
    assert all("jobs.spec" not in statement and "jobs.report" not in statement for statement, _ in queries)
