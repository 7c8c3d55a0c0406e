"""kill -9 of the API at every point of POST /v1/jobs: no answer without a job, no second job, nothing left behind."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import httpx
import pytest

from tests.service.server.api.crashing import JOB_STEPS, points
from tests.service.server.api.server import png
from tests.service.server.api.test_process import api_process, migrated
from tests.waiting import PATIENCE_S

CRASHING = [sys.executable, "-m", "tests.service.server.api.crashing"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "crashes",
    [("after store", "after create", "after engine"), points(JOB_STEPS)],
    ids=["around the job's row", "everywhere"],
)
def test_a_killed_post_is_a_job_or_nothing_and_can_be_sent_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, crashes: Sequence[str]
) -> None:
    """Each server finds what the one before it left when it was killed, and gets the same request again."""
    data, trap = tmp_path / "data", tmp_path / "trap"
    migrated(data)
    monkeypatch.setenv("CRASH_AT", str(trap))
    made: dict[str, str] = {}
    before: tuple[str, bytes] | None = None
    for point in [*crashes, ""]:
        with api_process(data, CRASHING) as (process, client):
            assert list((data / "uploads").glob("*")) == []
            if before is not None:
                made[before[0]] = _sent_again(client, *before, known=set(made.values()))
            if not point:
                break
            before = (point, png())
            trap.write_text(point, encoding="ascii")
            with pytest.raises(httpx.TransportError):
                _post(client, *before)
                pytest.fail(f"'{point}' was not reached")
            trap.unlink()
            assert process.wait(PATIENCE_S) == -signal.SIGKILL, point
    assert len(set(made.values())) == len(crashes)


def _post(client: httpx.Client, key: str, picture: bytes) -> httpx.Response:
    return client.post("/v1/jobs", files={"image": picture}, headers={"Idempotency-Key": key})


def _sent_again(client: httpx.Client, key: str, picture: bytes, *, known: set[str]) -> str:
    """The id of the one job of this key; one that was there before it was asked for again is the same."""
    found = {job["id"] for job in client.get("/v1/jobs").json()["jobs"]} - known
    assert len(found) <= 1, key
    ids = set()
    for _ in range(2):
        answer = _post(client, key, picture)
        assert answer.status_code == 202, answer.text
        ids.add(answer.json()["id"])
    jobs = {job["id"] for job in client.get("/v1/jobs").json()["jobs"]} - known
    assert jobs == ids and len(ids) == 1 and found <= ids, key
    return ids.pop()
