"""A shop for the page: a real `serve` with worker and agents, a simulated mill with a cable to pull, one milled job."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx

from machines.simulated import SimulatedMill, serve_tcp
from machines.simulated.endpoints import Endpoint
from service.server.database.connection import connect
from service.settings import ServerSettings
from service.store.opening import open_store
from tests.service.mills import AT_ZERO, program
from tests.service.server.api.server import ApiServer
from tests.service.server.fleet.shop import await_agent, kill_agents
from tests.service.server.supervisor.processes import Serving, offer_code, running
from tests.waiting import PATIENCE_S, seen, until

MILL = "shop"
TIME_FACTOR = 20.0
PICTURE = Path(__file__).parents[2] / "examples" / "logo.png"
# A lens that two slow cores have programs for within seconds. The journey asks for the same by hand: whichever of them
# comes second has its stages done already.
SMALL_SPEC: dict[str, Any] = {
    "preset": "draft",
    "image": {"pixels": 64},
    "optics": {"width_mm": 10.0, "height_mm": 10.0},
    "passes": [
        {"name": "rough", "radius_mm": 3.0, "pitch_mm": 0.5, "stock_to_leave_mm": 0.2},
        {"name": "finish", "radius_mm": 3.0, "pitch_mm": 0.25, "step_down_mm": 0.4},
    ],
}
JOB_S = 4 * PATIENCE_S  # the first one may compile all kernels, on a computer that has much else to do
JOB_MS = 1000 * JOB_S
LONG_PROGRAM = "pass-1-finish.nc"
LONG_LINES = 8000  # at this feed, minutes of the mill's time even twenty times as fast: longer than any test looks on
LONG_FEED = 150
# Power-up where a homing cycle would have left it, room for the lens around it, and switches to home by.
_MILL = replace(AT_ZERO, power_up_machine_mm=(-150.0, -150.0, -20.0), homing=True)
_PROFILE = 'extends = "grbl"\ndescription = "the mill by the window"\nhoming = true\n[link]\nport = "{port}"\n'


class Made(ApiServer):
    """Puts files and states into the tables of a server that is another process."""

    def __init__(self, settings: ServerSettings) -> None:
        self.services = SimpleNamespace(  # type: ignore[assignment]
            settings=settings, database=connect(settings.sqlalchemy_url), store=open_store(settings)
        )


@dataclass
class Shop:
    """`serving` is the process of `causticmill serve`; it is another one after `start`."""

    folder: Path
    mill: Endpoint
    serving: Serving
    arguments: tuple[str, ...]
    _stack: contextlib.ExitStack = field(repr=False)
    _keys: dict[str, str] = field(default_factory=dict, repr=False)
    _code: str = ""
    _job: str = ""
    _long_job: str = ""

    @property
    def data(self) -> Path:
        return self.folder / "data"

    @property
    def url(self) -> str:
        return self.serving.url

    @property
    def code(self) -> str:
        """A code for running mills from a page."""
        self._code = self._code or offer_code(self.data)
        return self._code

    def key(self, name: str = "Ada") -> str:
        """A token of this person, got for the code."""
        if name not in self._keys:
            answer = httpx.post(
                f"{self.url}/v1/pairings", json={"code": self.code, "name": name}, trust_env=False, timeout=PATIENCE_S
            )
            assert answer.status_code == 201, answer.text
            self._keys[name] = str(answer.json()["token"])
        return self._keys[name]

    @contextlib.contextmanager
    def client(self) -> Iterator[httpx.Client]:
        headers = {"Authorization": f"Bearer {self.key('the tests')}"}
        with httpx.Client(base_url=self.url, headers=headers, timeout=PATIENCE_S, trust_env=False) as client:
            yield client

    def submit(self, spec: dict[str, Any] | None = None) -> str:
        """A job by the API; its id."""
        with self.client() as client:
            form = {"spec": json.dumps(SMALL_SPEC if spec is None else spec)}
            answer = client.post("/v1/jobs", files={"image": ("logo.png", PICTURE.read_bytes())}, data=form)
            assert answer.status_code == 202, answer.text
            return str(answer.json()["id"])

    def succeeded(self, job: str) -> str:
        now = self._until_ended(job)
        assert now["state"] == "succeeded", now
        return job

    def _until_ended(self, job: str) -> dict[str, Any]:
        address, ended = f"/v1/jobs/{job}", ("succeeded", "failed", "cancelled")
        with self.client() as client:
            found: dict[str, Any]
            found = seen(
                lambda: client.get(address).json(), lambda now: now["state"] in ended, every_s=0.1, within_s=JOB_S
            )
            return found

    def job(self) -> str:
        """The one small job with programs that the tests of this session share."""
        self._job = self._job or self.submit()
        return self.succeeded(self._job)

    def begin(self) -> str:
        """A job whose stages are still to be done: the one that all share, where nobody has asked for that yet."""
        if self._job:
            return self.submit(SMALL_SPEC | {"image": {"pixels": 32}, "optics": {"width_mm": 6.0, "height_mm": 6.0}})
        self._job = self.submit()
        return self._job

    def told(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """This job and its files, as the API tells them."""
        with self.client() as client:
            address = f"/v1/jobs/{self.job()}"
            return client.get(address).json(), client.get(f"{address}/artifacts").json()["artifacts"]

    def long_job(self) -> str:
        """A job with one program, of some minutes of the mill's time, as it is once its stages are done."""
        if not self._long_job:
            job = self.submit()
            with self.client() as client:
                client.post(f"/v1/jobs/{job}:cancel")
            self._until_ended(job)
            path = program(self.folder / "long.nc", LONG_LINES, step_mm=0.1, feed_mm_per_min=LONG_FEED)
            made = Made(ServerSettings(data=self.data))
            made.put_artifact(job, LONG_PROGRAM, path.read_bytes(), stage="pass-1")
            made.put_stage(job, "check")
            made.put_state(job, "succeeded")
            self._long_job = job
        return self._long_job

    def machine(self) -> dict[str, Any]:
        with self.client() as client:
            found: dict[str, Any] = client.get(f"/v1/machines/{MILL}").json()
            return found

    def pull_cable(self) -> None:
        with self.mill.lock:
            self.mill.mill.unplug()

    def plug_in(self) -> None:
        with self.mill.lock:
            self.mill.mill.replug()

    def kill_api(self) -> None:
        """What a crash of the API process is; the supervisor starts it anew."""
        self.serving.kill(self.serving.child("service.server.api.main"))

    def stop(self) -> None:
        """The whole server ends; agents and mills live on."""
        self.serving.process.terminate()
        self.serving.ended()

    def start(self) -> None:
        """And comes back at the same address."""
        port = self.url.rpartition(":")[2]
        self.serving = self._stack.enter_context(_served(self.folder, self.arguments, port=port))


@contextlib.contextmanager
def running_shop(folder: Path, *arguments: str) -> Iterator[Shop]:
    with contextlib.ExitStack() as stack:
        mill = stack.enter_context(serve_tcp(SimulatedMill(_MILL), "127.0.0.1", 0, TIME_FACTOR))
        machines = folder / "config" / "machines"
        machines.mkdir(parents=True)
        (machines / f"{MILL}.toml").write_text(_PROFILE.format(port=mill.url))
        stack.callback(kill_agents, folder)
        serving = stack.enter_context(_served(folder, arguments))
        shop = Shop(folder, mill, serving, arguments, stack)
        await_agent(folder / "data" / "agents" / MILL)
        until(lambda: (shop.machine()["mill"] or {}).get("connected"), what="a connected mill")
        yield shop


@contextlib.contextmanager
def _served(folder: Path, arguments: tuple[str, ...], port: str = "0") -> Iterator[Serving]:
    data = folder / "data"
    command = [sys.executable, "-m", "service.cli.main", "serve", "--data", str(data), "--port", port, *arguments]
    environment = {
        "CAUSTICMILL_CONFIG_DIR": str(folder / "config"),
        "XDG_STATE_HOME": str(folder / "state"),
        "CAUSTICMILL_FREE_DISK_MB": "0",
    }
    with running(command, data, environment) as serving:
        serving.until_ready()
        yield serving
