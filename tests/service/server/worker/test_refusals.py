"""A worker does not start where jobs could be lost or done twice; it says why in one line, with exit code 2."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import sqlalchemy as sa

from service.errors import InputError
from service.server.database.connection import connect
from service.server.worker.worker import NameLock, file_system_of, refuse_network_disk
from service.settings import ServerSettings
from tests.service.server.worker.postgres import Postgres, missing, running_postgres
from tests.waiting import PATIENCE_S

MOUNTS = """\
22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw
30 22 0:40 / {nas} rw,relatime shared:5 - nfs4 server:/export rw
31 22 0:41 / {nas}ty rw - tmpfs tmpfs rw
"""


def started(environment: Mapping[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "service.server.worker.main"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def refusal_beside(first: ServerSettings, second: ServerSettings) -> str:
    """What the second worker says as it gives up, while the first runs and goes on to run."""
    one = started(first.environment())
    assert one.stdout is not None
    try:
        assert one.stdout.readline().startswith("ready")
        two = started(second.environment())
        _, words = two.communicate(timeout=PATIENCE_S)
        assert two.returncode == 2
        assert one.poll() is None
    finally:
        one.terminate()
        one.communicate(timeout=PATIENCE_S)
    assert one.returncode == 0
    errors = [line for line in words.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    return errors[0]


@pytest.mark.thorough
def test_a_second_worker_on_one_sqlite_folder(tmp_path: Path) -> None:
    settings = ServerSettings(data=tmp_path / "data")
    assert "another worker has" in refusal_beside(settings, settings)


@pytest.mark.thorough
def test_two_workers_of_one_name_on_postgresql(tmp_path: Path, postgres: Postgres) -> None:
    common = {
        "database_url": postgres.url(),
        "store_url": (tmp_path / "store").as_uri(),
        "store_is_shared": True,
        "executor": "twin",
    }
    first, second = (ServerSettings.load(data=tmp_path / name, **common) for name in "ab")
    assert "another worker runs as twin" in refusal_beside(first, second)


def test_postgresql_with_a_store_of_this_computer_alone(tmp_path: Path) -> None:
    settings = ServerSettings(data=tmp_path, database_url="postgresql://nowhere.invalid/x")
    worker = started(settings.environment())
    _, words = worker.communicate(timeout=PATIENCE_S)
    assert worker.returncode == 2
    assert "CAUSTICMILL_STORE_URL" in words


def test_sqlite_on_a_network_disk(tmp_path: Path) -> None:
    """The longest mount point that holds the folder counts, not one whose name only begins alike."""
    mounts = MOUNTS.format(nas=tmp_path / "nas")
    assert file_system_of(tmp_path / "nas" / "deep" / "data", mounts) == "nfs4"
    assert file_system_of(tmp_path / "nasty", mounts) == "tmpfs"
    assert file_system_of(tmp_path / "local", mounts) == "ext4"
    with pytest.raises(InputError, match="network file system"):
        refuse_network_disk(ServerSettings(data=tmp_path / "nas" / "data"), lambda: mounts)
    refuse_network_disk(ServerSettings(data=tmp_path / "local"), lambda: mounts)


@pytest.mark.thorough
def test_the_lock_of_a_name_comes_back_after_a_crash_of_the_database() -> None:
    """Also when the first attempts to lock it again find no database."""
    if reason := missing():
        pytest.skip(reason)
    with running_postgres() as server:
        database = connect(server.url().replace("postgresql://", "postgresql+psycopg://"))
        lock = NameLock(database, "one")
        server.stop("immediate")
        for _ in range(2):
            with pytest.raises(sa.exc.OperationalError):
                lock.keep()
        server.start()
        lock.keep()
        with pytest.raises(InputError, match="another worker runs as one"):
            NameLock(database, "one")
        lock.close()
        database.dispose()
