"""A real API server in this process: uvicorn on a loopback socket, SQLite, the local store. No worker."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import socket
import threading
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import uvicorn
from PIL import Image

from service.http.admission import Admission
from service.http.hosts import bind_address, url_of
from service.server.api.main import open_services, server_of
from service.server.api.services import Services
from service.server.database.connection import begin_writing, connect
from service.server.database.job_rows import Counter, add_to_counters, write_event
from service.server.database.schema import upgrade_schema
from service.server.database.tables import artifacts, jobs, stage_runs
from service.settings import ServerSettings
from tests.service import databases
from tests.waiting import PATIENCE_S, until


class ApiServer:
    """`client` talks to it over the wire; `services` are its own, for a look behind."""

    def __init__(self, services: Services, address: str, server: uvicorn.Server, admission: Admission) -> None:
        self.admission = admission
        self.services = services
        self.address = address
        self.server = server
        self.client = httpx.Client(base_url=address, timeout=PATIENCE_S)

    @property
    def port(self) -> int:
        return int(self.address.rpartition(":")[2])

    def submit(self, **form: Any) -> dict[str, Any]:
        """A new job by POST; the picture is unlike every other unless one is given."""
        image = form.pop("image", None) or ("picture.png", png())
        answer = self.client.post("/v1/jobs", files={"image": image}, **form)
        assert answer.status_code == 202, answer.text
        return answer.json()

    def put_artifact(self, job_id: str, name: str, content: bytes, *, stage: str = "map") -> str:
        """A file of a job, as a worker commits it; sha256."""
        path = self.services.settings.data / "made"
        path.write_bytes(content)
        stored = self.services.store.put_file(path)
        path.unlink()
        row = {"job_id": job_id, "name": name, "sha256": stored.sha256, "bytes": stored.bytes, "stage": stage}
        with begin_writing(self.services.database) as connection:
            connection.execute(artifacts.insert().values(**row, created_at=time.time()))
        return stored.sha256

    def put_stage(self, job_id: str, stage: str, state: str = "committed") -> None:
        row = {"job_id": job_id, "attempt": 1, "number": 1, "stage": stage, "state": state, "key": "0" * 64}
        row |= {"executor": "test", "fence": 1, "started_at": time.time() - 1, "ended_at": time.time()}
        with begin_writing(self.services.database) as connection:
            connection.execute(stage_runs.insert().values(**row))
            add_to_counters(connection, {Counter("stage_runs", stage, state): 1})

    def put_state(self, job_id: str, state: str, **values: Any) -> None:
        with begin_writing(self.services.database) as connection:
            changed = {"state": state, "version": jobs.c.version + 1, **values}
            connection.execute(jobs.update().where(jobs.c.id == job_id).values(**changed))

    def put_event(self, job_id: str, kind: str, **data: Any) -> None:
        with begin_writing(self.services.database) as connection:
            write_event(connection, job_id, kind, data, at=time.time())

    def files(self) -> set[str]:
        """Every file of the data folder but the database's own and what only says that somebody is there."""
        found = (path for path in self.services.settings.data.rglob("*") if path.is_file())
        names = {str(path.relative_to(self.services.settings.data)) for path in found}
        return {name for name in names if "sqlite" not in name and not name.endswith("guard")}


@contextlib.contextmanager
def api_server(data: Path, *, admission: Admission | None = None, **settings: Any) -> Iterator[ApiServer]:
    given = ServerSettings.load(
        **{"data": data, "port": 0, "requests_per_s": 1e5, "jobs_per_min": 1e6, "free_disk_mb": 0} | settings
    )
    migrate(given)
    with contextlib.closing(bind_address(given.host, given.port)) as listener, open_services(given) as services:
        admission = admission or Admission(most=1000, strangers=200)
        with _serve(services, listener, admission) as server:
            running = ApiServer(services, url_of(listener), server, admission)
            with running.client:
                yield running


def migrate(settings: ServerSettings) -> None:
    """Its tables up to date; a new SQLite file is a copy of one that was made once."""
    if settings.embedded and not settings.sqlite.exists():
        databases.copy_to(settings, engine=False)
        return
    database = connect(settings.sqlalchemy_url)
    upgrade_schema(database)
    database.dispose()


@contextlib.contextmanager
def _serve(services: Services, listener: socket.socket, admission: Admission) -> Iterator[uvicorn.Server]:
    accepts = threading.Event()  # uvicorn's own `started` comes before our acceptor listens
    server = server_of(services, accepts.set, admission=admission)
    thread = threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listener])), daemon=True)
    thread.start()
    until(lambda: accepts.is_set() or not thread.is_alive())
    assert accepts.is_set()
    try:
        yield server
    finally:
        server.should_exit = True
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


_shade = 0


def png(side: int = 24) -> bytes:
    """A small picture unlike all before it in this process."""
    global _shade
    _shade += 1
    image = Image.new("L", (side, side), _shade % 251)
    image.putpixel((_shade % side, _shade // side % side), 255)
    image.putpixel((0, 0), _shade // 251 % 251)
    return encoded(image)


def encoded(image: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    buffer = BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def problem(answer: httpx.Response, status: int, field: str | None = None) -> dict[str, Any]:
    """The answer is a problem of this status (and about this field)."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == status and body["type"].startswith("urn:causticmill:problem:") and body["detail"]
    if field is not None:
        assert body["field"] == field
    if not answer.request.url.path.startswith(("/v1/machines", "/v1/runs")):  # what mills say has codes
        said = {body["detail"], *(row["detail"] for row in body.get("problems", []))}
        assert sorted(said - body.get("phrases", {}).keys()) == []  # another language can say all of it
    return dict(body)
