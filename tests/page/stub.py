"""A server for tests of the page that does nothing: the page's own files as they are served, and canned answers.

It knows one finished job, two mills that stand idle, and everybody. What it says is what the API's document allows
(tests/page/answers.py); what another state would say, tests tell their page by `page.route`. A stream stays open. A
stop is told in the mill's stream, and moves nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import re
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import asdict
from typing import Any

import uvicorn
from fastapi import FastAPI, Request, WebSocket
from starlette.datastructures import MutableHeaders
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.hosts import bind_address, url_of
from service.http.problems import Problem
from service.job.spec.tools import BUILT_IN, load_tools
from service.server.api.errors import install_problems
from service.server.api.routes import page
from tests.page import canned_job
from tests.page.answers import asked_wrongly, lies_of
from tests.page.canned_job import COUPON_EXAMPLE, ESTIMATE_EXAMPLE, LOOK_EXAMPLE, PROFILE_EXAMPLE
from tests.page.machine_states import MACHINE, NAME
from tests.waiting import PATIENCE_S, until

_ANYBODY = {
    "name": "anonymous", "scopes": ["jobs:read", "jobs:write"], "anonymous": True, "paired": False, "expires_at": None,
}  # fmt: skip
_SIMULATED = MACHINE | {"name": "simulated", "simulated": True}
ON_THE_MILL = canned_job.RUN_EXAMPLE["job"]
GOING = "00000000-0000-4000-8000-00000000901a"  # a job that is worked on for ever
Answer = Callable[..., Any]


class Stub:
    """It answers first, and what it has said is held against the API's document at the end of a test."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.pictures: dict[str, bytes] = {}  # of more jobs in its list
        self._said: list[tuple[str, str, int, str, str, str | None]] = []
        self._check: set[tuple[str, ...]] = set()
        self._streams: set[asyncio.Queue[str]] = set()
        self._numbers = itertools.count(2)

    def key(self, name: str = "Ada") -> str:
        """A token of this person."""
        return f"cm_{name}"

    # ------------------------------------------------------------ answers

    def whoami(self, request: Request) -> dict[str, Any]:
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if not scheme:
            return _ANYBODY
        if not token.startswith("cm_"):
            raise Problem(401, "this token is not known", field="Authorization")
        scopes = ["jobs:read", "jobs:write", "machine:run"]
        name = token.removeprefix("cm_")
        return {"name": name, "scopes": scopes, "anonymous": False, "paired": True, "expires_at": None}

    def jobs(self, _request: Request) -> dict[str, Any]:
        mine = summary_of(canned_job.job())
        more = []
        for job in self.pictures:
            address = f"/v1/jobs/{job}/artifacts/thumbnail.png"
            more.append(mine | {"id": job, "links": mine["links"] | {"picture": address}})
        return {"jobs": [mine, *more], "next": None}

    def job_told(self, _request: Request, job: str) -> dict[str, Any]:
        if job == GOING:
            return canned_job.job() | {"id": GOING, "state": "running", "progress": 0.4, "report": None, "programs": []}
        if job == ON_THE_MILL:
            return canned_job.job() | {"id": job}
        if job != canned_job.JOB_ID:
            raise Problem(404, f"there is no job {job}", field="id")
        return canned_job.job()

    def file(self, request: Request, job: str, name: str) -> Response:
        content = self.pictures[job] if job in self.pictures else canned_job.files()[name]
        kind = next(one["media_type"] for one in canned_job.artifacts() if one["name"] == name)
        shown = "inline" if kind == "image/png" else "attachment"
        headers = {
            "ETag": f'"{job}-{name}"', "Accept-Ranges": "bytes", "Cache-Control": "private, no-cache",
            "Content-Disposition": f'{shown}; filename="{name}"', "X-Content-Type-Options": "nosniff",
        }  # fmt: skip
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", request.headers.get("range", ""))
        if asked is None:
            return Response(content, media_type=kind, headers=headers)
        start, end = int(asked[1]), min(len(content), int(asked[2] or len(content)) + 1)
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{len(content)}"
        return Response(content[start:end], status_code=206, media_type=kind, headers=headers)

    def program(self, request: Request, job: str, number: str) -> Response:
        return self.file(request, job, canned_job.job()["programs"][int(number) - 1]["name"])

    def job_events(self, _request: Request, job: str) -> Response:
        return self._stream([]) if job == GOING else Response(status_code=204)

    def machine_events(self, _request: Request, machine: str) -> Response:
        told = next(one for one in (MACHINE, _SIMULATED) if one["name"] == machine)
        return self._stream([_event("status", told), _event("log", _entry(1, "connected"))])

    def stop(self, _request: Request, machine: str, how: str) -> Response:
        entry = _event("log", _entry(next(self._numbers), how) | {"code": how, "values": {}})
        for queue in self._streams:
            queue.put_nowait(entry)
        return JSONResponse({"machine": machine, "order": how, "mill": MACHINE["mill"]}, status_code=202)

    def _stream(self, first: list[str]) -> Response:
        async def told() -> AsyncIterator[str]:
            queue: asyncio.Queue[str] = asyncio.Queue()
            self._streams.add(queue)
            try:
                for event in first:
                    yield event
                while True:
                    yield await queue.get()
            finally:
                self._streams.discard(queue)

        return StreamingResponse(told(), media_type="text/event-stream")

    # ------------------------------------------------------------ which

    def answer(self, request: Request, body: bytes) -> Response:
        at = request.url.path
        for method, pattern, made in self._routes():
            if method == request.method and (found := re.fullmatch(pattern, at)):
                told = made(request, *found.groups())
                answer = told if isinstance(told, Response) else JSONResponse(told)
                self._note(request, answer, body.decode() if body[:1] == b"{" else None)
                return answer
        raise Problem(404, f"this is a stub, which has no answer to {request.method} {at}")

    def _routes(self) -> list[tuple[str, str, Answer]]:
        job, machine = "/v1/jobs/([0-9a-f-]+)", f"/v1/machines/({NAME}|simulated)"
        return [
            ("GET", "/v1/whoami", self.whoami),
            ("GET", "/v1/jobs", self.jobs),
            ("GET", job, self.job_told),
            ("GET", f"{job}/request", lambda _request, _job: canned_job.request()),
            (
                "GET",
                f"{job}/artifacts",
                lambda _request, job: {"artifacts": [] if job == GOING else canned_job.artifacts()},
            ),
            ("GET", f"{job}/artifacts/([a-z0-9.-]+)", self.file),
            ("GET", f"{job}/programs/([0-9]+)", self.program),
            ("GET", f"{job}/events", self.job_events),
            ("POST", "/v1/estimates", lambda _: ESTIMATE_EXAMPLE),
            ("POST", f"{job}/photos", lambda _request, _job: LOOK_EXAMPLE),
            ("POST", "/v1/profiles/([^/]+)/coupon/photos", lambda _request, _profile: COUPON_EXAMPLE),
            ("GET", "/v1/machines", lambda _: {"machines": [_SIMULATED, MACHINE], "problems": []}),
            ("GET", machine, lambda _request, name: _SIMULATED if name == "simulated" else MACHINE),
            ("GET", f"{machine}/events", self.machine_events),
            ("GET", f"{machine}/orders", lambda _request, _name: {"orders": [_entry(1, "connected")], "next": None}),
            ("POST", f"{machine}/control/(hold|abort)", self.stop),
            ("GET", "/v1/profiles", lambda _: {"profiles": PROFILES}),
            ("GET", "/v1/tools", lambda _: {"tools": TOOLS, "own": False}),
            ("GET", "/v1/runs", lambda _: {"runs": [], "next": None}),
        ]

    def _note(self, request: Request, answer: Response, asked: str | None) -> None:
        kind = answer.headers.get("content-type", "")
        if isinstance(answer, StreamingResponse) or not kind.startswith("application/json"):
            return
        body = bytes(answer.body).decode()
        known = (request.method, request.url.path, body, asked or "")
        if known not in self._check:
            self._check.add(known)
            self._said.append((request.method, request.url.path, answer.status_code, kind, body, asked))

    def lies(self) -> list[str]:
        """What it has said since the last look, or was asked and took, against the API's document."""
        found: list[str] = []
        said, self._said = self._said, []
        for method, path, status, kind, body, asked in said:
            found += lies_of(method, path, status=status, kind=kind, body=body)
            if asked is not None:
                found += asked_wrongly(method, path, asked)
        return found


def keeping_files(app: ASGIApp) -> ASGIApp:
    """The files of the page stay in the browser as long as the stub runs: half of what loading them anew would cost."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        async def kept(message: Message) -> None:
            if message["type"] == "http.response.start" and scope["path"].startswith(page.PREFIX):
                MutableHeaders(scope=message)["Cache-Control"] = "max-age=86400, immutable"
            await send(message)

        await app(scope, receive, kept)

    return answer


@contextlib.contextmanager
def running_stub() -> Iterator[Stub]:
    """On a socket of its own, in a thread of this process."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    install_problems(app)
    app.include_router(page.router)
    with contextlib.closing(bind_address("127.0.0.1", 0)) as listener:
        stub = Stub(url_of(listener))

        async def answer(request: Request) -> Response:
            return stub.answer(request, await request.body())

        app.add_api_route("/v1/{rest:path}", answer, methods=["GET", "HEAD", "POST", "DELETE"], response_model=None)

        async def refuse(way: WebSocket) -> None:
            await way.accept()
            await way.close(4401)

        app.add_api_websocket_route("/v1/stops", refuse)
        config = uvicorn.Config(keeping_files(app), log_level="warning", access_log=False, timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listener])), daemon=True)
        thread.start()
        until(lambda: server.started or not thread.is_alive(), what="a stub that serves")
        try:
            yield stub
        finally:
            server.should_exit = True
            thread.join(PATIENCE_S)


def _event(kind: str, told: dict[str, Any]) -> str:
    return f"event: {kind}\ndata: {json.dumps(told)}\n\n"


def _entry(number: int, words: str) -> dict[str, Any]:
    return {"number": number, "at_s": time.time(), "kind": "order", "words": words, "by": "Ada"}


def summary_of(job: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in job.items() if key not in ("report", "spec", "stages", "programs")}


TOOLS = [asdict(tool) for tool in load_tools(BUILT_IN)]
PROFILES = [
    PROFILE_EXAMPLE | {"name": name, "description": words, "mills": mills, "built_in": name != NAME}
    for name, words, mills in (
        ("grbl", "desktop router", [{"name": "simulated", "simulated": True}]),
        ("grbl-3018", "engraver", []),
        (NAME, "the mill by the window", [{"name": NAME, "simulated": False}]),
    )
]
