"""A file that this program replaces is the old one or the new one, whatever happens between; what server and agents
keep can be read by nobody else, even where they are started with umask 0.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.errors import FailedError
from service.processes.files import keep_private, open_whole, write_whole
from service.store.local import LocalStore
from tests.page.shop import PICTURE, SMALL_SPEC
from tests.service.milling.agent.process import AgentProcess
from tests.service.mills import bench, program
from tests.service.server.fleet.shop import CHECKS
from tests.service.server.supervisor.processes import offer_code, served
from tests.waiting import PATIENCE_S, until

SERVICE = Path(__file__).parents[3] / "service"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, OSError])
def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    kept = tmp_path / "kept"
    kept.write_text("old")
    with pytest.raises(error), open_whole(kept) as file:
        file.write(b"new")
        raise error
    assert kept.read_text() == "old" and list(tmp_path.iterdir()) == [kept]


def test_the_name_is_taken_once_the_bytes_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, seen = tmp_path / "kept", list[str]()
    kept.write_text("old")
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda descriptor: (sync(descriptor), seen.append(kept.read_text())))
    write_whole(kept, "new")
    assert (seen, kept.read_text(), list(tmp_path.iterdir())) == (["old"], "new", [kept])


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_the_new_file_has_the_mode_asked_for(tmp_path: Path, mode: int) -> None:
    kept = tmp_path / "kept"
    kept.write_text("old")
    kept.chmod(0o666)
    before = os.umask(0o022)
    try:
        write_whole(kept, "new", mode)
    finally:
        os.umask(before)
    assert kept.stat().st_mode & 0o777 == mode


def test_no_other_module_replaces_files_in_its_own_way() -> None:
    """Beside it sync: the store and what it is filled from, whose names are those of their content."""
    found = {path.relative_to(SERVICE).as_posix() for path in SERVICE.rglob("*.py") if "os.fsync(" in path.read_text()}
    by_content = {"store/local.py", "client/download.py", "milling/agent/programs.py", "server/database/backup.py"}
    assert found == by_content | {"processes/files.py"}


@pytest.fixture
def open_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


def open_to_others(folder: Path) -> dict[str, str]:
    """What others may do something with, by its mode. A link has no mode of its own."""
    found = {}
    for path in (folder, *folder.rglob("*")):
        try:
            mode = path.lstat().st_mode
        except FileNotFoundError:  # gone meanwhile
            continue
        if not stat.S_ISLNK(mode) and mode & 0o077:
            found[str(path.relative_to(folder))] = oct(stat.S_IMODE(mode))
    return found


@pytest.mark.thorough
def test_nothing_of_a_server_is_open_to_others(tmp_path: Path, open_umask: None) -> None:
    """Databases with their logs, uploads, objects, stage logs and scratch, locks, the simulated mill and its agent."""
    data = tmp_path / "shop" / "data"
    with served("--with-simulated-mill", data=data, CAUSTICMILL_CONFIG_DIR=str(tmp_path / "config")) as serving:
        serving.until_ready()
        with httpx.Client(base_url=serving.url, timeout=PATIENCE_S, trust_env=False) as client:
            given = {"code": offer_code(data), "name": "Ada"}
            client.headers["Authorization"] = f"Bearer {client.post('/v1/pairings', json=given).json()['token']}"
            form = {"spec": json.dumps(SMALL_SPEC)}
            job = client.post("/v1/jobs", files={"image": PICTURE.read_bytes()}, data=form).json()["id"]
            until(lambda: client.get(f"/v1/jobs/{job}/artifacts").json()["artifacts"], what="a stage's files")
            until(lambda: (client.get("/v1/machines/simulated").json()["mill"] or {}).get("state"), what="an agent")
            kept = {path.name for path in data.rglob("*")}
            assert {"causticmill.sqlite-wal", "engine.sqlite", "serve.lock", "objects", "scratch", "agent.json"} <= kept
            assert open_to_others(tmp_path / "shop") == {}


@pytest.mark.thorough
def test_nothing_of_an_agent_is_open_to_others(tmp_path: Path, open_umask: None) -> None:
    """Journal, programs, keys, card, token, lock, and what pre-flight found."""
    with bench(8.0) as mill, AgentProcess(tmp_path / "shop" / "mill", mill.url) as agent:
        agent.until(lambda status: status["status"]["state"] == "idle")
        path = program(tmp_path / "part.nc", 20)
        run = agent.post("/v1/runs", 201, program=agent.upload(path), name="part.nc", key="k")["id"]
        agent.post(f"/v1/runs/{run}:start", 202, operator="Ada", checks=CHECKS)
        agent.until(lambda status: status["run"] is None or status["run"]["state"] == "finished")
        kept = {path.name for path in (tmp_path / "shop").rglob("*")}
        assert {"agent.json", "client-keys.json", "token", "lock", "programs", "preflight"} <= kept
        assert any(path.is_file() and run in str(path.parent) for path in (tmp_path / "shop").rglob("*")), "a journal"
        assert open_to_others(tmp_path / "shop") == {}


def test_a_folder_that_was_open_is_closed_with_all_that_is_in_it(tmp_path: Path, open_umask: None) -> None:
    """And from then on it stays so: new files and folders are private, too. What is outside is left alone."""
    data, outside = tmp_path / "data", tmp_path / "outside"
    (data / "objects" / "ab").mkdir(parents=True)
    (data / "objects" / "ab" / "one").write_text("1")
    (data / "objects" / "ab" / "one").chmod(0o444)
    (data / "causticmill.sqlite").touch()
    outside.touch()
    (data / "port").symlink_to(outside)
    assert len(open_to_others(data)) == 5
    keep_private(data)
    assert stat.S_IMODE((data / "objects" / "ab" / "one").stat().st_mode) == 0o400
    (data / "new").mkdir()
    (data / "new" / "file").touch()
    assert open_to_others(data) == {}
    assert stat.S_IMODE(outside.stat().st_mode) == 0o666


def test_a_folder_of_other_things_is_not_closed(tmp_path: Path, open_umask: None) -> None:
    """`--data .` in a home, or `--data /`: a folder of its own is asked for, and nothing is changed."""
    (tmp_path / "home" / "pictures").mkdir(parents=True)
    before = open_to_others(tmp_path / "home")
    with pytest.raises(FailedError, match="give a folder of its own"):
        keep_private(tmp_path / "home")
    with pytest.raises(FailedError, match="give a folder of its own"):
        LocalStore(tmp_path / "home")
    assert open_to_others(tmp_path / "home") == before and len(before) == 2
    keep_private(tmp_path / "home" / "mill")
    assert len(open_to_others(tmp_path / "home")) == 2


def test_a_folder_that_cannot_be_closed_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A volume of another account, say: whoever may enter it could read the database."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    data = tmp_path / "data"
    data.mkdir()
    data.chmod(0o755)
    monkeypatch.setattr(Path, "chmod", refuse)
    with pytest.raises(FailedError, match=rf"{data}: others may enter it, .*chmod 700"):
        keep_private(data)
