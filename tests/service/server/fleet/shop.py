"""A small shop: a simulated mill on a pty, its profile, its real agent, a real API server, and a job with programs.

Server and agent are threads of this process. Where a law is about an agent's process, its death for example, a test
asks for one (`start=start_agents`).
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest

from machines.mill.orders import Stop
from machines.preflight.preflight import MillLimits, Preflight
from service.http.problems import GRANT
from service.milling import preflight
from service.milling.agent.card import AgentCard, read_card
from service.milling.preflight_child import examine
from service.server.database.tokens import TokenScope
from service.server.fleet.agent_launcher import is_owned
from service.settings import ServerSettings
from tests.service.milling.agent.client import await_agent
from tests.service.milling.agent.in_process import AgentThread
from tests.service.mills import Bench, program
from tests.service.server.api.server import ApiServer, api_server, png
from tests.waiting import PATIENCE_S, seen, until

MACHINE = "shop"
CHECKS = ["tool", "zero", "stock", "clear"]
LINES = (40, 60, 30)
LOOK_S = 0.1  # between two questions to a server
_threads: list[AgentThread] = []


@dataclass
class Shop:
    """`operator` calls with a token that may run machines and read jobs."""

    data: Path
    bench: Bench
    server: ApiServer
    operator: httpx.Client
    jobs: list[str] = field(default_factory=list)

    @property
    def settings(self) -> ServerSettings:
        return self.server.services.settings

    @property
    def folder(self) -> Path:
        return self.settings.agents_folder / MACHINE

    def card(self) -> AgentCard:
        found = read_card(self.folder)
        assert found is not None
        return found

    def token(self, *scopes: str, name: str = "") -> str:
        name = name or f"t{time.monotonic_ns()}"
        return self.server.services.tokens.create(name, scopes)[1]

    def client(self, *scopes: str, address: str = "") -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.token(*scopes)}"}
        return httpx.Client(base_url=address or self.server.address, headers=headers, timeout=PATIENCE_S)

    def job(self, lines: tuple[int, ...] = LINES, state: str = "succeeded") -> str:
        """A job as it is once its stages are done: a program of so many cuts for each pass."""
        services = self.server.services
        posted = self.server.client.post(
            "/v1/jobs",
            files={"image": ("p.png", png())},
            headers={"Authorization": f"Bearer {self.token('jobs:write')}"},
        )
        assert posted.status_code == 202, posted.text
        job = str(posted.json()["id"])
        for number, count in enumerate(lines, start=1):
            path = program(self.data / f"{number}.nc", count)
            content = path.read_bytes() + f"(job {job} pass {number})\n".encode()
            kind = "rough" if number < len(lines) else "finish"
            self.server.put_artifact(job, f"pass-{number}-{kind}.nc", content, stage=f"pass-{number}")
        self.server.put_stage(job, "check")
        self.server.put_state(job, state, ended_at=time.time())
        assert services.book.get(job).state == state
        return job

    # ------------------------------------------------------------------ as the operator

    def get(self, path: str, status: int = 200) -> Any:
        answer = self.operator.get(path)
        assert answer.status_code == status, answer.text
        return answer.json()

    def post(self, path: str, status: int, **body: Any) -> Any:
        answer = self.order(path, status, **({"json": body} if body else {}))
        assert answer.status_code == status, answer.text
        return answer.json()

    def order(self, path: str, *statuses: int, **request: Any) -> httpx.Response:
        """Give an order, and give it again where it was refused because a busy machine was too late to send it."""
        return seen(
            lambda: give(self.operator, path, **request),
            lambda answer: answer.status_code in statuses or answer.json().get("code") != "grant_expired",
            every_s=LOOK_S,
        )

    def recover(self, run: Any, checks: list[str]) -> None:
        """Go on with a run by the plan that was read last; it is read again where it has become another since."""
        path, said = f"/v1/runs/{run['id']}", {"operator": "Ada", "checks": checks}

        def give() -> httpx.Response:
            self.get(f"{path}/recovery")
            return self.order(f"{path}:recover", 202, json=said)

        answer = seen(give, lambda answer: answer.json().get("code") != "plan_changed", every_s=LOOK_S)
        assert answer.status_code == 202, answer.text

    def park(self, job: str, status: int = 201, *, machine: str = MACHINE, **more: Any) -> Any:
        """A run that could not be parked in time (kernels that have to be compiled first) is waited for."""
        answer = self.operator.post(f"/v1/machines/{machine}/runs", json={"job": job, **more})
        if answer.status_code == 202 and status == 201:
            return self.until_state(answer.json(), "parked")
        assert answer.status_code == status, answer.text
        return answer.json()

    def start(self, run: Any, status: int = 202, checks: list[str] | None = None) -> Any:
        return self.post(f"/v1/runs/{run['id']}:start", status, operator="Ada", checks=checks or run["required_checks"])

    def until(self, run: Any, good: Callable[[Any], bool]) -> Any:
        return seen(lambda: self.get(f"/v1/runs/{run['id']}"), good, every_s=LOOK_S)

    def until_state(self, run: Any, *states: str) -> Any:
        return self.until(run, lambda now: now["state"] in states)

    def until_finished(self, run: Any) -> Any:
        """What is left to be cut is cut in a hurry."""
        self.bench.hurry()
        return self.until_state(run, "finished")

    def until_cut(self, blocks: int) -> None:
        until(lambda: len(self.bench.cut) >= blocks)

    def until_idle(self) -> None:
        def idle() -> bool:
            mill = self.get(f"/v1/machines/{MACHINE}")["mill"]
            return bool(mill) and mill["state"] == "idle"

        seen(idle, bool, every_s=LOOK_S)


def give(client: httpx.Client, path: str, *, machine: str = MACHINE, **request: Any) -> httpx.Response:
    """Post as a page does: an order under a grant of this moment, for which a refusal of the grant is the answer."""
    if not is_order(path):
        return client.post(path, **request)
    headers = request.pop("headers", None) or {}
    granted = client.post(f"/v1/machines/{machine}/grants", headers=headers)
    if granted.status_code != 201:
        return granted
    return client.post(path, headers=headers | {GRANT: str(granted.json()["grant"])}, **request)


def is_order(path: str) -> bool:
    """It needs a grant."""
    what = path.rpartition("/")[2]
    return what.endswith((":start", ":resume", ":recover")) or ("/control/" in path and what not in set(Stop))


def write_profile(port: str, *, name: str = MACHINE, text: str = "") -> Path:
    """A profile of the person's own, in the folder that the environment names."""
    folder = Path(os.environ["CAUSTICMILL_CONFIG_DIR"]) / "machines"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(text or f'extends = "grbl"\ndescription = "the mill by the window"\n[link]\nport = "{port}"\n')
    return path


def agent_pids(data: Path) -> list[int]:
    """Living owners of the mill folders below, agents whose port is not open yet included; not this process."""
    pids = []
    for lock in data.rglob("lock"):
        if is_owned(lock.parent) and (text := lock.read_text().strip()).isdigit():
            pids.append(int(text))
    return [pid for pid in pids if pid != os.getpid()]


def kill_agents(data: Path, number: signal.Signals = signal.SIGKILL) -> None:
    """And wait until they are gone, which their locks show. Those of this process are told to stop."""
    for thread in [one for one in _threads if one.folder.is_relative_to(data)]:
        thread.stop()
        _threads.remove(thread)
    for pid in agent_pids(data):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
    until(lambda: not agent_pids(data))


def start_here(settings: ServerSettings) -> None:
    """The agent of the shop's mill in this process, where it has none yet."""
    folder = settings.agents_folder / MACHINE
    if not is_owned(folder):
        _threads.append(AgentThread(MACHINE, folder))


@contextlib.contextmanager
def shop(
    data: Path, bench: Bench, *, start: Callable[[ServerSettings], object] = start_here, **settings: Any
) -> Iterator[Shop]:
    """An API server on this data folder, and the agent of its mill, which outlives it.

    start : `start_agents` for an agent in a process of its own, as `serve` has it
    """
    with api_server(data, **settings) as server:
        start(server.services.settings)
        found = Shop(data, bench, server, httpx.Client(timeout=PATIENCE_S))
        with found.client(TokenScope.JOBS_READ, TokenScope.MACHINE_RUN) as found.operator:
            await_agent(found.folder)
            found.until_idle()
            yield found


def own_folders(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """And an agent in this process reads programs itself: pre-flight's process loads compiled kernels each time."""
    monkeypatch.setenv("XDG_STATE_HOME", str(folder / "state"))
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(folder / "config"))
    monkeypatch.setattr(preflight, "_compute", _read_here)


def _read_here(path: Path, limits: MillLimits, folder: Path, held_against: str, _: object) -> Preflight:
    found = examine(path, limits, lambda _share: None)
    (folder / f"{held_against}-{found.bytes}-{found.sha256}.json").write_text(found.to_json(), encoding="utf-8")
    return found
