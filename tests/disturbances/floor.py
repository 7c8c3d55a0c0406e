"""A shop floor while a program runs: real `serve`, real agent, a simulated mill, each a process of its own."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import httpx

from service.milling.agent.card import read_card
from service.server.database.connection import connect
from service.server.database.tokens import TokenBook, TokenScope
from service.settings import PREFIX, ServerSettings
from tests.disturbances.mill import MillProcess
from tests.disturbances.proxy import HoldingProxy
from tests.page.shop import Made
from tests.service.mills import ends, program
from tests.service.server.fleet.shop import await_agent, give
from tests.service.server.supervisor.processes import Serving, running
from tests.trials.judge import Verdict, judge
from tests.waiting import PATIENCE_S, seen

ROOT = Path(__file__).parents[2]
_USUAL_FILES = 1024  # open at once, unless a process asks for more: what systems give
MILL = "floor"
PROGRAM = "pass-1-finish.nc"
STEP_MM = 0.1
_DAY_S = 86400.0
_PROFILE = 'extends = "grbl"\ndescription = "the mill by the window"\n[link]\nport = "{port}"\n'
_ENDED = ("finished", "interrupted", "aborted", "lost")
_SCOPES = (TokenScope.JOBS_READ, TokenScope.JOBS_WRITE, TokenScope.MACHINE_RUN)


@dataclass
class Floor:
    """`server` calls as an operator does; `agent` calls the agent itself, on a connection that is kept open."""

    folder: Path
    settings: ServerSettings
    mill: MillProcess
    serving: Serving
    lines: int
    agent_process: subprocess.Popen[bytes]
    agent_folder: Path
    proxy: HoldingProxy | None
    token: str = ""
    run: str = ""
    _stack: contextlib.ExitStack = field(default_factory=contextlib.ExitStack, repr=False)

    @property
    def url(self) -> str:
        return self.serving.url

    @property
    def server(self) -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.token}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=PATIENCE_S, trust_env=False, verify=False)

    @property
    def agent_token(self) -> str:
        return (self.agent_folder / "token").read_text().strip()

    @property
    def agent_url(self) -> str:
        return (self.agent_folder / "url").read_text()

    @contextlib.contextmanager
    def agent_client(self, *, timeout_s: float = PATIENCE_S) -> Iterator[httpx.Client]:
        """One connection, open already and kept: it is there when no other can be made any more."""
        headers = {"Authorization": f"Bearer {self.agent_token}"}
        limits = httpx.Limits(max_connections=1, keepalive_expiry=None)
        with httpx.Client(
            base_url=self.agent_url, headers=headers, timeout=timeout_s, limits=limits, trust_env=False, verify=False
        ) as client:
            client.get("/v1/status").raise_for_status()
            yield client

    @contextlib.contextmanager
    def database(self) -> Iterator[Any]:
        """The server's tables."""
        made = connect(self.settings.sqlalchemy_url)
        try:
            yield made
        finally:
            made.dispose()

    def new_token(self, name: str) -> str:
        """As a page has it; others would end the anonymous use of this server."""
        with self.database() as database:
            return TokenBook(database).create_paired(name, _SCOPES, life_s=_DAY_S)[1]

    # ------------------------------------------------------------------ a program

    def job(self) -> str:
        """A job with one program, as it is once its stages are done."""
        from tests.service.server.api.server import png

        with self.server as client:
            posted = client.post("/v1/jobs", files={"image": ("p.png", png())})
            assert posted.status_code == 202, posted.text
            job = str(posted.json()["id"])
            client.post(f"/v1/jobs/{job}:cancel")
            seen(lambda: client.get(f"/v1/jobs/{job}").json(), lambda now: now["state"] == "cancelled", every_s=0.05)
        path = program(self.folder / "program.nc", self.lines, step_mm=STEP_MM)
        made = Made(self.settings)
        made.put_artifact(job, PROGRAM, path.read_bytes(), stage="pass-1")
        made.put_stage(job, "check")
        made.put_state(job, "succeeded", ended_at=time.time())
        made.services.database.dispose()
        return job

    def start(self) -> None:
        """Hand the program over and start it; it runs when this returns."""
        job = self.job()
        with self.server as client:
            answer = client.post(f"/v1/machines/{MILL}/runs", json={"job": job})
            assert answer.status_code in (201, 202), answer.text
            self.run = str(answer.json()["id"])
            parked = self.until_state("parked")
            said = {"operator": "Ada", "checks": parked["required_checks"]}
            answer = give(client, f"/v1/runs/{self.run}:start", json=said, machine=MILL)
            assert answer.status_code == 202, answer.text
            self.until_state("running")
        seen(lambda: self.mill.cut, lambda cut: cut > 2, what="the first cuts", every_s=0.05)

    def look(self) -> dict[str, Any]:
        """The run, as the server has it."""
        with self.server as client:
            return cast(dict[str, Any], client.get(f"/v1/runs/{self.run}").json())

    def until_state(self, *states: str) -> dict[str, Any]:
        return self.until(lambda now: now.get("state") in states)

    def until(self, good: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Look at the run until it is good; a server that cannot answer just now is asked again."""

        def look() -> dict[str, Any]:
            with contextlib.suppress(httpx.HTTPError, ValueError):
                return self.look()
            return {}

        return seen(look, good, every_s=0.05)

    def until_ended(self) -> dict[str, Any]:
        return self.until_state(*_ENDED)

    def at_agent(self) -> dict[str, Any]:
        """The one run, as the agent has it."""
        with self.agent_client() as client:
            return cast(dict[str, Any], client.get("/v1/status").json()["run"])

    def until_cut(self, more: int) -> None:
        """So many more cuts than there are now."""
        before = self.mill.cut
        seen(lambda: self.mill.cut, lambda cut: cut >= before + more, every_s=0.05)

    def verdict(self) -> Verdict:
        """What was cut against the program. What has no share of it is `skipped`, and foreign cuts are named."""
        return judge([(0.0, 0.0, 0.0), *ends(self.lines, STEP_MM)], self.mill.cuts())

    # ------------------------------------------------------------------ the server's processes

    def kill_api(self) -> None:
        self.serving.kill(self.serving.child("service.server.api.main"))

    def restart_server(self, *, killed: bool = False) -> None:
        """The whole server ends and comes back at the same address; agent and mill live on."""
        port = self.url.rpartition(":")[2]
        (self.serving.process.kill if killed else self.serving.process.terminate)()
        self.serving.ended()
        self.serving = self._stack.enter_context(_served(self.folder, self.settings, port=port))


@contextlib.contextmanager
def running_floor(
    folder: Path,
    *,
    lines: int,
    time_factor: float = 1.0,
    proxied: bool = False,
    agent_environment: Mapping[str, str] | None = None,
    server_environment: Mapping[str, str] | None = None,
    settings: ServerSettings | None = None,
) -> Iterator[Floor]:
    """Everything runs and the mill is connected; no program yet.

    proxied : between server and agent; agent_environment: of the agent's process
    """
    settings = settings or ServerSettings(data=folder / "data")
    settings = settings.model_copy(
        update={"free_disk_mb": 0, "start_agents": False, "prepare": False, "requests_per_s": 1e5, "port": 0}
    )
    machines, agent_folder = folder / "config" / "machines", settings.agents_folder.absolute() / MILL
    machines.mkdir(parents=True)
    settings.data.mkdir(mode=0o700, exist_ok=True)
    with contextlib.ExitStack() as stack:
        mill = stack.enter_context(MillProcess(folder, time_factor))
        (machines / f"{MILL}.toml").write_text(_PROFILE.format(port=mill.url))
        agent = stack.enter_context(_agent(folder, agent_folder, dict(agent_environment or {})))
        card = await_agent(agent_folder)
        (agent_folder / "url").write_text(card.url)
        proxy = None
        if proxied:
            proxy = stack.enter_context(HoldingProxy("127.0.0.1", int(card.url.rpartition(":")[2])))
            _announce_at(agent_folder, card.url, proxy.url)
        serving = stack.enter_context(_served(folder, settings, environment=server_environment))
        floor = Floor(folder, settings, mill, serving, lines, agent, agent_folder, proxy, _stack=stack)
        floor.token = floor.new_token("the tests")
        with floor.server as client:
            machine = f"/v1/machines/{MILL}"
            seen(lambda: client.get(machine).json()["mill"] or {}, lambda mill: mill.get("state") == "idle")
        yield floor


def _announce_at(folder: Path, old: str, new: str) -> None:
    path = folder / "agent.json"
    path.write_text(path.read_text().replace(old, new))
    assert (card := read_card(folder)) is not None and card.url == new


@contextlib.contextmanager
def _agent(folder: Path, data: Path, environment: Mapping[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """As `serve` starts it: words go to a file."""
    data.mkdir(parents=True, exist_ok=True)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(PREFIX)}
    command = [
        sys.executable,
        "-m",
        "service.cli.main",
        "mill",
        "--machine",
        MILL,
        "--data",
        str(data),
        "--bind-port",
        "0",
    ]
    with (folder / "agent.log").open("wb") as log:
        process = subprocess.Popen(
            command, cwd=ROOT, env={**kept, **_folders(folder), **environment},
            stdin=subprocess.DEVNULL, stdout=log, stderr=log, preexec_fn=_limit_files,
        )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _limit_files() -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (_USUAL_FILES, hard))


def _folders(folder: Path) -> dict[str, str]:
    return {f"{PREFIX}CONFIG_DIR": str(folder / "config"), "XDG_STATE_HOME": str(folder / "state")}


@contextlib.contextmanager
def _served(
    folder: Path, settings: ServerSettings, *, port: str = "0", environment: Mapping[str, str] | None = None
) -> Iterator[Serving]:
    own = {name: value for name, value in settings.environment().items() if name.startswith(PREFIX)}
    command = [sys.executable, "-m", "service.cli.main", "serve", "--data", str(settings.data), "--port", port]
    given = own | _folders(folder) | dict(environment or {})
    given.pop(f"{PREFIX}PORT", None)
    with running(command, settings.data, given) as serving:
        serving.until_ready()
        yield serving
