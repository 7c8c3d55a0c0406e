"""kill -9 of the API at every point of POST runs: one parked run at the mill's agent, found again, never started."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.milling.agent.card import AgentCard
from tests.service.mills import Bench
from tests.service.server.api.test_process import api_process
from tests.service.server.fleet.shop import MACHINE, shop
from tests.waiting import PATIENCE_S, until

CRASHES = [f"after {step}" for step in ("row", "put", "post", "parked")]
CRASHING = [sys.executable, "-m", "tests.service.server.api.crashing"]


@pytest.mark.thorough
def test_a_killed_hand_over_is_one_parked_run_or_none(
    tmp_path: Path, mill: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After each of its steps that leaves something behind: here, at the agent's store, at its mill, here again."""
    data, trap = tmp_path / "data", tmp_path / "trap"
    monkeypatch.setenv("CRASH_AT", str(trap))
    with shop(data, mill) as floor:
        jobs = {point: floor.job((20,)) for point in CRASHES}
        headers, card = {"Authorization": f"Bearer {floor.token('machine:run', 'jobs:read')}"}, floor.card()
    before = ""
    for point in [*jobs, ""]:
        with api_process(data, CRASHING) as (process, client):
            client.headers.update(headers)
            client.timeout = httpx.Timeout(40)
            if before:
                _found_again(client, card, before, jobs[before])
            if not point:
                break
            trap.write_text(point, encoding="ascii")
            with pytest.raises(httpx.TransportError):
                _post(client, point, jobs[point])
                pytest.fail(f"'{point}' was not reached")
            trap.unlink()
            assert process.wait(PATIENCE_S) == -signal.SIGKILL, point
            before = point
    assert mill.cut == []


def _post(client: httpx.Client, key: str, job: str) -> httpx.Response:
    return client.post(f"/v1/machines/{MACHINE}/runs", json={"job": job}, headers={"Idempotency-Key": key})


def _found_again(client: httpx.Client, card: AgentCard, key: str, job: str) -> None:
    """Sent again it is the same run, and the agent has one of it, parked; it is given up in the end."""
    run = _post(client, key, job)
    assert run.status_code in (201, 202), (key, run.text)
    address = f"/v1/runs/{run.json()['id']}"
    until(lambda: client.get(address).json()["state"] == "parked")
    assert _post(client, key, job).json()["id"] == run.json()["id"]
    assert len(client.get("/v1/runs", params={"job": job}).json()["runs"]) == 1
    assert [one["state"] for one in _at_the_agent(card, run.json()["program"]["sha256"])] == ["parked"], key
    client.post(f"{address}:abort").raise_for_status()


def _at_the_agent(card: AgentCard, sha256: str) -> list[Any]:
    """Its runs of a program, which is of one job only."""
    token = Path(card.token_file).read_text().strip()
    runs = httpx.get(
        f"{card.url}/v1/runs", headers={"Authorization": f"Bearer {token}"}, trust_env=False, timeout=PATIENCE_S
    ).json()
    return [one for one in runs["runs"] if one["program"] == sha256]
