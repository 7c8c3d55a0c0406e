"""/v1/runs: parked, started, held, resumed, aborted, recovered. Each start is a person's word, by name."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.gcode.preflight import Preflight
from machines.mill.mill import Mill
from machines.runs import RECOVER_CHECKS, START_CHECKS, Confirmation, RunView
from service.agent.agent import Agent
from service.agent.bodies import fields_of
from service.web.problems import Problem


class RunRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._parking = asyncio.Lock()

    def routes(self) -> list[Route]:
        return [
            Route("/v1/runs", self.listed, methods=["GET"]),
            Route("/v1/runs", self.parked, methods=["POST"]),
            Route("/v1/runs/{run}:start", self.started, methods=["POST"]),
            Route("/v1/runs/{run}:recover", self.recovered, methods=["POST"]),
            Route("/v1/runs/{run}:hold", self.told(Mill.hold, urgent=True), methods=["POST"]),
            Route("/v1/runs/{run}:abort", self.told(Mill.abort, urgent=True), methods=["POST"]),
            Route("/v1/runs/{run}:resume", self.told(Mill.resume), methods=["POST"]),
            Route("/v1/runs/{run}/recovery", self.recovery, methods=["GET"]),
            Route("/v1/runs/{run}", self.shown, methods=["GET"]),
        ]

    async def listed(self, _request: Request) -> Response:
        return JSONResponse({"runs": [run.as_dict() for run in self._runs()]})

    async def shown(self, request: Request) -> Response:
        return JSONResponse(self._run(request).as_dict())

    async def parked(self, request: Request) -> Response:
        fields = await fields_of(request)
        program = fields.text("program")
        name = fields.text("name", program[:12], longest=200)
        key = fields.text("key", longest=100) if fields.has("key") else ""
        fields.done()
        path = self._agent.store.path_of(program)
        async with self._parking:  # a client that asks again must not overtake itself
            if (known := self._parked_before(key, program)) is not None:
                return _parked(known, status=200)
            facts: Preflight = await self._agent.access.work(lambda: self._agent.preflight(path))
            run: RunView = await self._agent.access.call(lambda mill: self._park(mill, facts, path, name))
            if key:
                self._agent.keys.remember(key, run.id)
        return _parked(run, status=201)

    def _park(self, mill: Mill, facts: Preflight, path: Path, name: str) -> RunView:
        """On the mill's thread, as is a removal: the program is still there once the run is known."""
        self._agent.store.entry(path.stem)
        return mill.park(facts, path, name)

    def _parked_before(self, key: str, program: str) -> RunView | None:
        """The run that this key has parked; a Problem where it was for another program."""
        run_id = self._agent.keys.run_of(key) if key else None
        run = next((run for run in self._runs() if run.id == run_id), None)
        if run is not None and run.program != program:
            raise Problem(409, f"key '{key}' has parked run {run.id} of another program; take a new key", field="key")
        return run

    async def started(self, request: Request) -> Response:
        run, said = self._run(request), await _confirmation(request, START_CHECKS)
        await self._agent.access.call(lambda mill: mill.start(run.id, said))
        return self._now(request)

    async def recovered(self, request: Request) -> Response:
        run, said = self._run(request), await _confirmation(request, RECOVER_CHECKS)
        await self._agent.access.call(lambda mill: mill.recover(run.id, said))
        return self._now(request)

    async def recovery(self, request: Request) -> Response:
        run = self._run(request)
        plan = await self._agent.access.call(lambda mill: mill.plan_recovery(run.id))
        return JSONResponse(plan.as_dict())

    def told(self, function: Callable[[Mill], None], *, urgent: bool = False) -> Callable[..., object]:
        """A control of the live run. Of another run it would be an order to the wrong one: refused."""

        async def endpoint(request: Request) -> Response:
            run = self._run(request)
            live = self._agent.access.snapshot.run
            if live is None or live.id != run.id:
                raise Problem(
                    409, f"run {run.id} is {run.state.value}, not live; POST /v1/control/hold holds the mill itself"
                )
            call = self._agent.access.urgent if urgent else self._agent.access.call
            await call(function)
            return self._now(request)

        return endpoint

    def _now(self, request: Request) -> Response:
        return JSONResponse(self._run(request).as_dict(), status_code=202)

    def _runs(self) -> tuple[RunView, ...]:
        return self._agent.access.snapshot.runs

    def _run(self, request: Request) -> RunView:
        wanted = request.path_params["run"]
        for run in self._runs():
            if run.id == wanted:
                return run
        raise Problem(404, f"no run '{wanted}' here; GET /v1/runs lists them", field="run")


def _parked(run: RunView, *, status: int) -> Response:
    return JSONResponse(run.as_dict(), status_code=status, headers={"Location": f"/v1/runs/{run.id}"})


async def _confirmation(request: Request, allowed: frozenset[str]) -> Confirmation:
    fields = await fields_of(request)
    said = Confirmation(operator=fields.text("operator", longest=100), checks=fields.texts("checks", allowed))
    fields.done()
    return said
