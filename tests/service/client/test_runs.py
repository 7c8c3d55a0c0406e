"""`runs`: a program from a job to the mill, each step a command; nothing moves without what a person has to confirm."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from machines.simulated import SimulatedMill
from service.client import runs
from tests.service.client.shop import run
from tests.service.mills import bench
from tests.service.server.fleet.shop import MACHINE, kill_agents, own_folders, shop, write_profile
from tests.trials.server.processes import wait_until
from tests.waiting import PATIENCE_S


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
    """Its job has a short program, and one that nobody waits for the end of."""
    folder = tmp_path_factory.mktemp("mill-shop")
    with pytest.MonkeyPatch.context() as patch, bench(40.0) as mill:
        own_folders(patch, folder)
        write_profile(mill.url, name=MACHINE)
        try:
            with shop(folder / "data", mill) as floor:
                job = floor.job((100, 16_000))
                token, reader = floor.token("jobs:read", "jobs:write", "machine:run"), floor.token("jobs:read")
                yield MillShop(floor.server.address, mill.mill, job, token, reader)
        finally:
            kill_agents(folder)


@pytest.mark.thorough
def test_a_program_is_parked_confirmed_and_cut(mill_shop: MillShop) -> None:
    """Parked it waits; without every confirmation it does not start; with them it is cut to the end."""
    code, out, errors = mill_shop.run("park", mill_shop.job, "--machine", MACHINE)
    assert code == 0, errors
    run_id = out.split()[0]
    assert "pass-1-rough.nc" in out and "tool:" in out and "zero:" in out
    assert wait_until(lambda: mill_shop.state(run_id) == "parked", PATIENCE_S)
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
    code, out, _ = mill_shop.run("list", "--machine", MACHINE)
    assert code == 0 and run_id in out


@pytest.mark.thorough
def test_a_run_is_held_resumed_and_aborted(mill_shop: MillShop) -> None:
    """The next pass is chosen by itself. An aborted run is a failure for whoever waits for it."""
    code, out, errors = mill_shop.run("park", mill_shop.job, "--machine", MACHINE, "--program", "2")
    assert code == 0, errors
    run_id = out.split()[0]
    assert "change:" in out
    assert wait_until(lambda: mill_shop.state(run_id) == "parked", PATIENCE_S)
    assert mill_shop.run("start", run_id, "--confirm", "tool,zero,stock,clear")[0] == 0
    assert mill_shop.run("hold", run_id)[0] == 0
    assert wait_until(lambda: mill_shop.state(run_id) == "held", PATIENCE_S)
    assert mill_shop.run("resume", run_id)[0] == 0
    assert wait_until(lambda: mill_shop.state(run_id) == "running", PATIENCE_S)
    assert mill_shop.run("abort", run_id)[0] == 0
    code, _, errors = mill_shop.run("follow", run_id)
    assert code == 1 and "aborted" in errors


def test_who_may_only_read_moves_nothing(mill_shop: MillShop) -> None:
    code, _, errors = mill_shop.run("park", mill_shop.job, "--machine", MACHINE, token=mill_shop.reader)
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

    monkeypatch.setattr(runs, "stream_events", events)
    runs.follow_run(SimpleNamespace(get=lambda _: told("running")), "a")  # type: ignore[arg-type]
    assert re.findall(r"([\d.]+) % of", capsys.readouterr().out) == ["10.0", "60.0"]
