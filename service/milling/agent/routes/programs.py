"""/v1/programs: the agent's own copies, brought by the caller or fetched from the job server, by hash."""

from __future__ import annotations

from collections.abc import AsyncIterator

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.mill.mill import Mill
from machines.runs import RunState
from phrases.phrase import Phrase
from service.http.problems import Problem
from service.milling.agent.agent import Agent
from service.milling.agent.programs import StoredProgram, fetch_program, valid_sha256
from service.milling.agent.requests import read_body
from service.milling.api import FetchBody


class ProgramRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent

    def routes(self) -> list[Route]:
        return [
            Route("/v1/programs", self.list_programs, methods=["GET"]),
            Route("/v1/programs", self.fetch, methods=["POST"]),
            Route("/v1/programs/{sha256}", self.show, methods=["GET"]),
            Route("/v1/programs/{sha256}", self.receive, methods=["PUT"]),
            Route("/v1/programs/{sha256}", self.delete, methods=["DELETE"]),
        ]

    async def list_programs(self, _request: Request) -> Response:
        entries = await self._agent.access.work(lambda: list(self._agent.store.entries()))
        return JSONResponse({"programs": [entry.as_dict() for entry in entries]})

    async def show(self, request: Request) -> Response:
        return JSONResponse((await self._find(request)).as_dict())

    async def receive(self, request: Request) -> Response:
        length = request.headers.get("content-length", "")
        announced = int(length) if length.isdigit() else None
        sha256 = valid_sha256(request.path_params["sha256"])
        return _program_response(*await self._agent.store.receive(sha256, _body(request), announced_bytes=announced))

    async def delete(self, request: Request) -> Response:
        """Delete a copy; one that a run may still need stays."""
        sha256 = (await self._find(request)).sha256

        def remove(mill: Mill) -> None:  # on the mill's thread: no run of it can be parked or recovered meanwhile
            needed = [run for run in mill.runs if run.program == sha256 and run.state is not RunState.FINISHED]
            if needed:
                words = ", ".join(f"{run.id} ({run.state.value})" for run in needed[:3])
                raise Problem(
                    409,
                    Phrase("program {sha256} is needed by run {runs}", sha256=sha256[:12], runs=words),
                    field="program",
                )
            self._agent.store.remove(sha256)

        await self._agent.access.call(remove)
        return Response(status_code=204)

    async def _find(self, request: Request) -> StoredProgram:
        return await self._agent.access.work(lambda: self._agent.store.entry(request.path_params["sha256"]))

    async def fetch(self, request: Request) -> Response:
        body = await read_body(request, FetchBody)
        sha256 = valid_sha256(body.sha256)
        return _program_response(*await fetch_program(self._agent.store, body.url, sha256, token=body.token))


async def _body(request: Request) -> AsyncIterator[bytes]:
    try:
        async for piece in request.stream():
            yield piece
    except ClientDisconnect:
        raise Problem(
            400, Phrase("the connection ended before the program did; nothing is kept"), field="program"
        ) from None


def _program_response(entry: StoredProgram, new: bool) -> Response:
    return JSONResponse(entry.as_dict(), status_code=201 if new else 200)
