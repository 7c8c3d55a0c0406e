"""/v1/runs: parked, started, held, resumed, aborted, recovered. Each start is a named person's order.

/v1/programs: the agent's own copies, brought by the caller or fetched from the job server, by hash.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from machines.errors import MillCode
from machines.mill.mill import Mill
from machines.mill.orders import Stop
from machines.preflight.preflight import Preflight
from machines.runs import RECOVER_CHECKS, START_CHECKS, Confirmation, RunReport, RunState
from phrases.phrase import Phrase
from service.http.problems import Problem
from service.milling.agent.agent import START_S, Agent
from service.milling.agent.programs import StoredProgram, fetch_program, valid_sha256
from service.milling.agent.requests import read_body, read_caller
from service.milling.api import ConfirmationBody, FetchBody, ParkBody, RecoverBody, StartBody


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

        def remove(mill: Mill) -> None:  # on the mill's thread: meanwhile no run of it can be parked or recovered
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


class RunRoutes:
    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._parking = asyncio.Lock()

    def routes(self) -> list[Route]:
        return [
            Route("/v1/runs", self.list_runs, methods=["GET"]),
            Route("/v1/runs", self.park, methods=["POST"]),
            Route("/v1/runs/{run}:start", self.start, methods=["POST"]),
            Route("/v1/runs/{run}:recover", self.recover, methods=["POST"]),
            Route("/v1/runs/{run}:hold", self.halt(Stop.HOLD), methods=["POST"]),
            Route("/v1/runs/{run}:abort", self.halt(Stop.ABORT), methods=["POST"]),
            Route("/v1/runs/{run}:resume", self.resume, methods=["POST"]),
            Route("/v1/runs/{run}/recovery", self.recovery, methods=["GET"]),
            Route("/v1/runs/{run}", self.show, methods=["GET"]),
        ]

    async def list_runs(self, _request: Request) -> Response:
        return JSONResponse({"runs": [run.as_dict() for run in self._runs()]})

    async def show(self, request: Request) -> Response:
        return JSONResponse(self._run(request).as_dict())

    async def park(self, request: Request) -> Response:
        body = await read_body(request, ParkBody)
        program, key, name, lift_mm = body.program, body.key, body.name or body.program[:12], body.lift_mm
        path = await self._agent.access.work(lambda: self._agent.store.path_of(program))
        async with self._parking:  # a repeated request must not overtake the first
            if (known := self._find_parked(key, program, lift_mm)) is not None:
                return _run_response(known, status=200)
            if lift_mm is not None:
                source, name = path, f"{name} +{lift_mm:g} mm"
                path = await self._agent.access.work(lambda: self._agent.make_dry_pass(source, lift_mm))
            facts: Preflight = await self._agent.access.work(
                lambda: self._agent.run_preflight(path, dry_pass=lift_mm is not None)
            )
            run: RunReport = await self._agent.access.call(lambda mill: self._park(mill, facts, path, name, body))
            if key:
                await self._agent.access.work(lambda: self._agent.keys.remember(key, run.id))
        return _run_response(run, status=201)

    def _park(self, mill: Mill, facts: Preflight, path: Path, name: str, body: ParkBody) -> RunReport:
        """Park on the mill's thread, which also runs removals, so that the program is still there once the run is
        known. The copies that earlier dry passes have left are removed.
        """
        self._agent.store.entry(path.stem)
        lifted_from = "" if body.lift_mm is None else body.program
        run = mill.park(facts, path, name, lift_mm=body.lift_mm, lifted_from=lifted_from)
        needed = {one.program for one in mill.runs if one.state is not RunState.FINISHED}
        for program in {one.program for one in mill.runs if one.lift_mm is not None} - needed:
            with contextlib.suppress(Problem):
                self._agent.store.remove(program)
        return run

    def _find_parked(self, key: str, program: str, lift_mm: float | None) -> RunReport | None:
        """Find the run that this key has parked; a Problem if it was for another program."""
        run_id = self._agent.keys.run_of(key) if key else None
        run = next((run for run in self._runs() if run.id == run_id), None)
        if run is not None and (run.lift_mm, run.lifted_from or run.program) != (lift_mm, program):
            raise Problem(
                409,
                Phrase("key '{key}' has parked run {run} of another program; take a new key", key=key, run=run.id),
                field="key",
            )
        return run

    async def start(self, request: Request) -> Response:
        run, body = self._run(request), await read_body(request, StartBody)
        said, setup = _read_confirmation(body, START_CHECKS), body.setup or None
        await self._agent.access.order(
            "start", lambda mill: mill.start(run.id, said, setup=setup), read_caller(request), within_s=START_S
        )
        return self._answer(request)

    async def recover(self, request: Request) -> Response:
        run, body = self._run(request), await read_body(request, RecoverBody)
        said, plan = _read_confirmation(body, RECOVER_CHECKS), body.plan
        await self._agent.access.order(
            "recover", lambda mill: mill.recover(run.id, said, plan_seen=plan), read_caller(request), within_s=START_S
        )
        return self._answer(request)

    async def recovery(self, request: Request) -> Response:
        run = self._run(request)
        plan = await self._agent.access.call(lambda mill: mill.plan_recovery(run.id))
        return JSONResponse(plan.as_dict())

    async def resume(self, request: Request) -> Response:
        self._require_present(run := self._run(request))
        await self._agent.access.order(f"resume {run.name}", Mill.resume, read_caller(request))
        return self._answer(request)

    def halt(self, stop: Stop) -> Callable[..., object]:
        """Make the endpoint of a stop of the live run. For another run it is refused but still counted, so that no
        earlier order, such as this run's start, is carried out any more.
        """

        async def endpoint(request: Request) -> Response:
            access = self._agent.access
            run = self._run(request)
            if access.snapshot.run is not None and access.snapshot.run.id == run.id:
                await access.halt(stop, read_caller(request))
            else:
                access.orders.count_stop()
                self._require_present(run)
            return self._answer(request)

        return endpoint

    def _require_present(self, run: RunReport) -> None:
        """Raise Problem 409 if the mill has another run, to which the order would be wrong."""
        present = self._agent.access.snapshot.run
        if present is None or present.id != run.id:
            raise Problem(
                409,
                f"run {run.id} is {run.state.value}, not live; POST /v1/control/hold holds the mill itself",
                code=MillCode.RUN_STATE,
                values={"state": run.state.value},
            )

    def _answer(self, request: Request) -> Response:
        return JSONResponse(self._run(request).as_dict(), status_code=202)

    def _runs(self) -> tuple[RunReport, ...]:
        return self._agent.access.snapshot.runs

    def _run(self, request: Request) -> RunReport:
        """Find a run by our own id, or by the key that the job server gave it."""
        wanted = request.path_params["run"]
        own = self._agent.keys.run_of(wanted) or wanted
        for run in self._runs():
            if run.id == own:
                return run
        raise Problem(404, Phrase("no run '{wanted}' here; GET /v1/runs lists them", wanted=wanted), field="run")


def _run_response(run: RunReport, *, status: int) -> Response:
    return JSONResponse(run.as_dict(), status_code=status, headers={"Location": f"/v1/runs/{run.id}"})


def _read_confirmation(body: ConfirmationBody, allowed: frozenset[str]) -> Confirmation:
    if not allowed.issuperset(body.checks):
        words = ", ".join(sorted(allowed))
        raise Problem(422, f"checks is {json.dumps(body.checks)}; allowed: a list of {words}", field="checks")
    return Confirmation(operator=body.operator, checks=frozenset(body.checks))
