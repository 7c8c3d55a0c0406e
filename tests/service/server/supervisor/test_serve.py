"""`causticmill serve` itself: worker, API, database and store as a person starts them."""

from __future__ import annotations

import json
import signal
import urllib.request
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.cli.main import run
from tests.levels import mostly_thorough
from tests.service.server.supervisor.processes import Serving, descendants, is_alive, served
from tests.waiting import PATIENCE_S, until

API, WORKER = "service.server.api.main", "service.server.worker.main"
STANDBY = "service.server.standby.main"


def ready(serving: Serving) -> bool:
    try:
        with urllib.request.urlopen(f"{serving.url}/readyz", timeout=PATIENCE_S) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


@pytest.mark.parametrize("starts", mostly_thorough((1, 2), quick=(1,)))
def test_it_is_ready_stops_well_and_starts_again(tmp_path: Path, starts: int) -> None:
    for _ in range(starts):
        with served("--no-agents", data=tmp_path) as serving:
            serving.until_ready()
            assert ready(serving)
            below = descendants(serving.pid)
            serving.kill(serving.pid, signal.SIGTERM)
            assert serving.ended() == 0
            assert not any(map(is_alive, below))
            assert not [line for line in serving.err if "error" in line.lower()], serving.err


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("module", "word", "told"),
    [
        (API, signal.SIGTERM, "ended with exit code 0"),
        (WORKER, signal.SIGKILL, "was ended by SIGKILL"),
        (STANDBY, signal.SIGKILL, "was ended by SIGKILL"),
    ],
)
def test_what_ended_is_ready_again(tmp_path: Path, module: str, word: signal.Signals, told: str) -> None:
    with served("--no-agents", data=tmp_path) as serving:
        serving.until_ready()
        before, below = serving.child(module), descendants(serving.child(module))
        serving.kill(before, word)
        until(lambda: serving.child(module) not in (0, before) and ready(serving), what="ready again")
        assert serving.process.poll() is None
        assert [line for line in serving.err if told in line], serving.err
        assert not any(map(is_alive, below))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "environment", "word"),
    [
        (("--slots", "0"), {}, "--slots"),
        (("--port", "70000"), {}, "--port"),
        ((), {"CAUSTICMILL_LEASE_S": "soon"}, "CAUSTICMILL_LEASE_S"),
        (("--store-url", "gs://bucket"), {}, "CAUSTICMILL_STORE_URL"),
        (("--database-url", "postgresql://localhost:1/x"), {}, "CAUSTICMILL_DATABASE_URL"),
        ((), {"CAUSTICMILL_SECRETS": "/nowhere"}, "CAUSTICMILL_SECRETS"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    tmp_path: Path, arguments: tuple[str, ...], environment: dict[str, str], word: str
) -> None:
    with served(*arguments, data=tmp_path, **environment) as serving:
        assert serving.ended() == 2
        lines = {line for line in serving.err if line.startswith("error:")}
        assert len(lines) == 1 and word in lines.pop()
        assert serving.out == []


def test_a_misspelt_setting_is_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAUSTICMILL_QOUTA_MB", "100")
    monkeypatch.setenv("CAUSTICMILL_TOKEN", "of the client")
    assert run(["service", "install", "--print"]) == 0
    warned = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning:")]
    assert warned == ["warning: CAUSTICMILL_QOUTA_MB is not a setting; CAUSTICMILL_QUOTA_MB is one"]


@pytest.mark.thorough
def test_a_full_disk_is_told_and_the_mills_have_their_agents(tmp_path: Path) -> None:
    """What keeps the server from being ready is said with its address; it does not keep agents from mills."""
    profile = tmp_path / "config/machines/router.toml"
    profile.parent.mkdir(parents=True)
    profile.write_text('extends = "grbl"\n[link]\nport = "socket://127.0.0.1:1"\n')
    wanted = {"CAUSTICMILL_FREE_DISK_MB": "1000000000000", "CAUSTICMILL_CONFIG_DIR": str(tmp_path / "config")}
    with served(data=tmp_path / "data", **wanted) as serving:
        until(lambda: serving.out, what="a line")
        assert "not ready: disk:" in serving.out[0] and "1000000000000 MB" in serving.out[0]
        until(lambda: [line for line in serving.err if "agent started" in line], what="an agent")
        (started,) = [line for line in serving.err if "agent started" in line]
        serving.kill(int(started.split("process ")[1].split(";")[0]))


@pytest.mark.thorough
@pytest.mark.parametrize("word", [signal.SIGTERM, signal.SIGKILL])
def test_a_running_stage_ends_with_it_and_the_job_goes_on_with_the_next(tmp_path: Path, word: signal.Signals) -> None:
    with served("--no-agents", data=tmp_path) as serving:
        serving.until_ready()
        job = submitted(serving)
        until_at_work(serving, job)
        below = descendants(serving.pid)
        assert len(below) > 3, "worker, API, fork server, stage"
        serving.kill(serving.pid, word)
        serving.ended()
        until(lambda: not any(map(is_alive, below)), what="the end of all")
    with served("--no-agents", data=tmp_path) as serving:
        serving.until_ready()
        until_beyond(serving, job, "heightfield")


@pytest.mark.thorough
def test_a_restored_folder_serves_and_goes_on_with_its_jobs(tmp_path: Path) -> None:
    backup, again = tmp_path / "backup.tar", tmp_path / "again"
    with served("--no-agents", data=tmp_path / "data") as serving:
        serving.until_ready()
        job = submitted(serving)
        until(lambda: answered(serving, job)["state"] == "running", what="a job that runs")
        assert run(["service", "backup", str(backup), "--data", str(tmp_path / "data")]) == 0
    assert run(["service", "restore", str(backup), "--data", str(again)]) == 0
    with served("--no-agents", data=again) as serving:
        serving.until_ready()
        until_beyond(serving, job, "heightfield")


SPEC = {
    "preset": "draft",
    "image": {"pixels": 32},
    "optics": {"width_mm": 8, "height_mm": 8, "throw_mm": 30},
    "stock": {"margin_mm": 2},
}
PICTURE = Path(__file__).parents[4] / "examples/logo.png"


def submitted(serving: Serving) -> str:
    """The id of a small job."""
    given = {"spec": json.dumps(SPEC)}
    with PICTURE.open("rb") as file:
        answer = httpx.post(
            f"{serving.url}/v1/jobs", files={"image": ("logo.png", file)}, data=given, timeout=PATIENCE_S
        )
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def answered(serving: Serving, job: str) -> dict[str, Any]:
    return dict(httpx.get(f"{serving.url}/v1/jobs/{job}", timeout=PATIENCE_S).json())


def until_at_work(serving: Serving, job: str) -> None:
    """A stage of it runs in a process of its own."""
    until(lambda: answered(serving, job)["stage"] not in (None, "image"), what="a stage that runs")


def until_beyond(serving: Serving, job: str, stage: str) -> None:
    """The job is at work again and has finished this stage. Its end is other tests' business: it takes a while."""

    def done() -> bool:
        stages = {row["name"]: row["state"] for row in answered(serving, job)["stages"]}
        return stages[stage] in ("committed", "reused")

    until(done, what=f"the end of stage {stage}")
    assert answered(serving, job)["state"] in ("running", "succeeded"), answered(serving, job)["error"]
