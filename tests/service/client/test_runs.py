"""`runs`: a program from a job to the mill, each step a command; nothing moves without what a person has to confirm."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from machines.simulated import GRBL_11, SimulatedMill
from machines.simulated.endpoints import serve_tcp
from service.client import runs
from service.settings import ServerSettings
from tests.page.shop import Made
from tests.service.client.shop import SMALL, run
from tests.service.mills import program
from tests.trials.server.deployment import embedded
from tests.trials.server.pictures import picture
from tests.trials.server.processes import wait_until


@dataclass(frozen=True)
class MillShop:
    """A server with one mill; `job` has two programs. `tokens`: with and without machine:run."""

    url: str
    mill: SimulatedMill
    job: str
    token: str
    reader: str

    def run(self, *words: str, token: str | None = None) -> tuple[int, str, str]:
        done = run("runs", *words, server=self.url, CAUSTICMILL_TOKEN=token or self.token)
        return done.returncode, done.stdout, done.stderr

    def state(self, run_id: str) -> str:
        out = self.run("show", run_id)[1]
        return next(line.split()[1].rstrip(",:") for line in out.splitlines() if line.startswith("state:"))


@pytest.fixture(scope="module")
def mill_shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MillShop]:
    folder = tmp_path_factory.mktemp("mill-shop")
    (folder / "config" / "machines").mkdir(parents=True)
    mill = SimulatedMill(GRBL_11)
    with serve_tcp(mill, "127.0.0.1", 0, 40.0) as endpoint:
        profile = f'extends = "grbl"\n[link]\nport = "{endpoint.url}"\n'
        (folder / "config" / "machines" / "router.toml").write_text(profile)
        own = {
            "CAUSTICMILL_CONFIG_DIR": str(folder / "config"),
            "CAUSTICMILL_START_AGENTS": "true",
            "XDG_STATE_HOME": str(folder / "state"),
        }
        data = folder / "data"
        scopes = {"all": "jobs:read,jobs:write,machine:run", "reader": "jobs:read"}
        tokens = {
            name: run("token", "create", name, "--scope", scope, "--data", str(data), "-q").stdout.strip()
            for name, scope in scopes.items()
        }
        with embedded(folder, environment=own) as deployment:
            job = _job_with_programs(deployment.url, folder, tokens["all"])
            yield MillShop(deployment.url, mill, job, tokens["all"], tokens["reader"])


def _job_with_programs(url: str, folder: Path, token: str) -> str:
    """A job as it is once its stages are done: a short program, and one that nobody waits for the end of."""
    (folder / "p.png").write_bytes(picture(0, 48))
    submitted = run("submit", str(folder / "p.png"), *SMALL, "-q", server=url, CAUSTICMILL_TOKEN=token)
    assert submitted.returncode == 0, submitted.stderr
    job = submitted.stdout.strip()
    for words in (("cancel", job), ("follow", job, "-q")):  # it need not be computed
        run("jobs", *words, server=url, CAUSTICMILL_TOKEN=token)
    made = Made(ServerSettings(data=folder / "data"))
    for number, (kind, lines) in enumerate((("rough", 100), ("finish", 16_000)), start=1):
        content = program(folder / "p.nc", lines, step_mm=0.5).read_bytes()
        made.put_artifact(job, f"pass-{number}-{kind}.nc", content, stage=f"pass-{number}")
    made.put_stage(job, "check")
    made.put_state(job, "succeeded")
    return job


@pytest.mark.thorough
def test_a_program_is_parked_confirmed_and_cut(mill_shop: MillShop) -> None:
    """Parked it waits; without every confirmation it does not start; with them it is cut to the end."""
    code, out, errors = mill_shop.run("park", mill_shop.job, "--machine", "router")
    assert code == 0, errors
    run_id = out.split()[0]
    assert "pass-1-rough.nc" in out and "tool:" in out and "zero:" in out
    assert wait_until(lambda: mill_shop.state(run_id) == "parked", 30.0)
    code, _, errors = mill_shop.run("start", run_id)
    assert code == 2 and "--confirm tool,zero,stock,clear" in errors
    code, _, errors = mill_shop.run("start", run_id, "--confirm", "tool,zero")
    assert code == 2 and "not confirmed: stock, clear" in errors
    assert mill_shop.mill.recording.cuts() == []
    words = ("start", run_id, "--confirm", "tool,zero,stock,clear", "--operator", "Kim", "--follow")
    code, out, errors = mill_shop.run(*words)
    assert code == 0, errors
    assert "finished" in out and "next:     program 2" in out
    shares = [float(share) for share in re.findall(r"([\d.]+) % of", out)]
    assert shares == sorted(shares), "how far it is never goes back"
    assert mill_shop.mill.recording.cuts() != []
    code, out, _ = mill_shop.run("list", "--machine", "router")
    assert code == 0 and run_id in out


@pytest.mark.thorough
def test_a_run_is_held_resumed_and_aborted(mill_shop: MillShop) -> None:
    """The next pass is chosen by itself. An aborted run is a failure for whoever waits for it."""
    code, out, errors = mill_shop.run("park", mill_shop.job, "--machine", "router", "--program", "2")
    assert code == 0, errors
    run_id = out.split()[0]
    assert "change:" in out
    assert wait_until(lambda: mill_shop.state(run_id) == "parked", 30.0)
    assert mill_shop.run("start", run_id, "--confirm", "tool,zero,stock,clear")[0] == 0
    assert mill_shop.run("hold", run_id)[0] == 0
    assert wait_until(lambda: mill_shop.state(run_id) == "held", 30.0)
    assert mill_shop.run("resume", run_id)[0] == 0
    assert wait_until(lambda: mill_shop.state(run_id) == "running", 30.0)
    assert mill_shop.run("abort", run_id)[0] == 0
    code, _, errors = mill_shop.run("follow", run_id)
    assert code == 1 and "aborted" in errors


def test_who_may_only_read_moves_nothing(mill_shop: MillShop) -> None:
    code, _, errors = mill_shop.run("park", mill_shop.job, "--machine", "router", token=mill_shop.reader)
    assert code == 2 and "machine:run" in errors and errors.count("\n") == 1
    code, _, errors = mill_shop.run("list", token="wrong-token")
    assert code == 2 and errors.count("\n") == 1


def test_a_mill_that_is_not_there_is_named(mill_shop: MillShop, tmp_path: Path) -> None:
    code, _, errors = mill_shop.run("park", mill_shop.job, "--machine", "lathe")
    assert code == 2 and "lathe" in errors


@pytest.mark.parametrize("verb", ["hold", "abort"])
def test_a_stop_that_may_not_have_arrived_sends_the_person_to_the_mill(verb: str) -> None:
    done = run("runs", verb, "0f3c", server="http://127.0.0.1:9")
    assert done.returncode == 1 and "use the mill's own stop" in done.stderr.splitlines()[-1]


def test_an_older_word_of_a_run_is_not_told_after_a_newer_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is asked for while the first event is on its way may be newer than that event."""
    shares = iter([0.1, 0.0, 0.6, 1.0, 1.0])

    def told(state: str) -> dict[str, Any]:
        return {"state": state, "share": next(shares), "lines": 9}

    def events(*_: object, **__: object) -> Iterator[SimpleNamespace | None]:
        yield None
        for state in ("running", "running", "finished"):
            yield SimpleNamespace(data=told(state))

    monkeypatch.setattr(runs, "lasting", events)
    runs.follow_run(SimpleNamespace(get=lambda _: told("running")), "a")  # type: ignore[arg-type]
    assert re.findall(r"([\d.]+) % of", capsys.readouterr().out) == ["10.0", "60.0"]
