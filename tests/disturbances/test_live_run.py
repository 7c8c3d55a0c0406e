"""Something fails while a program runs: nothing is lost, and the run goes on or stops in words.

Real processes and a simulated mill; in the end what it has cut is held against the program.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.server.stoppers import FILE as STOPPERS
from service.server.stoppers import hash_secret, read_stoppers
from service.settings import ServerSettings
from tests.disturbances.disk import SmallDisk, missing_for_slow, missing_for_small, slow_disk, small_disk
from tests.disturbances.floor import MILL, Floor, running_floor
from tests.disturbances.proxy import HoldingProxy
from tests.service.server.fleet.shop import give
from tests.service.server.worker.postgres import Postgres, missing, running_postgres
from tests.service.store.conftest import s3_address, s3_urls  # noqa: F401 - fixtures
from tests.waiting import PATIENCE_S, seen, until

LINES = 300
FACTOR = 2.0  # some ten seconds of cutting
_MORE = 10  # cuts that show that the mill goes on


@pytest.fixture
def small_disks(tmp_path: Path) -> Iterator[tuple[SmallDisk, SmallDisk]]:
    """The server's data folder and in it the agent's, each on a disk of its own."""
    if reason := missing_for_small():
        pytest.skip(reason)
    data = tmp_path / "data"
    with small_disk(data, mb=64) as servers, small_disk(data / "agents" / MILL, mb=80) as agents:
        yield servers, agents


@pytest.fixture
def postgres() -> Iterator[Postgres]:
    if reason := missing():
        pytest.skip(reason)
    with running_postgres(durable=True) as server:
        yield server


def require_whole(floor: Floor) -> None:
    """The run has finished, here and at the agent, and the mill has cut all of the program, once and nothing else."""
    ended = floor.until_ended()
    assert ended["state"] == "finished", ended
    assert floor.at_agent()["state"] == "finished"
    verdict = floor.verdict()
    assert verdict.clean and not verdict.recut, verdict


def post(floor: Floor, what: str, within_s: float = 20.0) -> httpx.Response:
    headers = {"Authorization": f"Bearer {floor.token}"}
    with httpx.Client(base_url=floor.url, headers=headers, timeout=within_s, trust_env=False) as client:
        return give(client, f"/v1/runs/{floor.run}:{what}", machine=MILL)


@pytest.mark.thorough
def test_an_agent_whose_disk_is_full_holds_in_words_and_goes_on_when_there_is_room(
    tmp_path: Path, small_disks: tuple[SmallDisk, SmallDisk]
) -> None:
    _, agents = small_disks
    with running_floor(tmp_path, lines=LINES, time_factor=FACTOR) as floor:
        floor.start()
        with agents.full():
            held = floor.until(lambda now: now.get("state") == "held")
            assert "no space left" in held["words"] and "make room" in held["words"], held
            assert floor.mill.held()
            assert post(floor, "resume").status_code in (409, 507), "resumed without a journal"
            assert floor.look()["state"] == "held"
        answer = post(floor, "resume")
        assert answer.status_code == 202, answer.text
        require_whole(floor)


@pytest.mark.thorough
def test_a_server_whose_disk_is_full_neither_stops_a_run_nor_loses_its_end(
    tmp_path: Path, small_disks: tuple[SmallDisk, SmallDisk]
) -> None:
    servers, _ = small_disks
    with running_floor(tmp_path, lines=LINES, time_factor=FACTOR) as floor:
        floor.start()
        with servers.full():
            floor.until_cut(_MORE)
            answer = post(floor, "hold")
            assert floor.mill.held(), answer.text
            floor.until(lambda now: now.get("state") == "held")
            answer = post(floor, "resume")
            assert answer.status_code == 202, answer.text
            floor.until_cut(_MORE)
            seen(lambda: floor.at_agent()["state"], lambda state: state == "finished", every_s=0.1)
        require_whole(floor)


@pytest.mark.thorough
def test_a_slow_disk_delays_no_cut(tmp_path: Path) -> None:
    """Each sync takes three seconds: the journal is as much later, the mill is not."""
    if reason := missing_for_slow():
        pytest.skip(reason)
    disk = slow_disk(tmp_path, tmp_path / "data" / "agents")
    with running_floor(tmp_path, lines=LINES, time_factor=FACTOR, agent_environment=disk.environment) as floor:
        floor.start()
        with disk.slow(3.0):
            floor.until_cut(_MORE)
            assert post(floor, "hold").status_code == 202
            floor.until_state("held")
            assert post(floor, "resume").status_code == 202
            require_whole(floor)
        assert floor.mill.held()


@pytest.mark.thorough
def test_a_stalled_disk_holds_the_run_in_words_and_an_abort_does_not_wait_for_it(tmp_path: Path) -> None:
    """A journal that was not safe for 30 s is none; whoever aborts then is not made to wait for the disk."""
    if reason := missing_for_slow():
        pytest.skip(reason)
    disk = slow_disk(tmp_path, tmp_path / "data" / "agents")
    with running_floor(tmp_path, lines=2000, agent_environment=disk.environment) as floor:
        floor.start()
        with disk.stalled():
            held = floor.until(lambda now: now.get("state") == "held")
            assert "the disk has not finished an fsync" in held["words"], held
            took = httpx.Timeout(10.0)
            headers = {"Authorization": f"Bearer {floor.token}"}
            answer = httpx.post(
                f"{floor.url}/v1/runs/{floor.run}:abort", headers=headers, timeout=took, trust_env=False
            )
            assert answer.status_code == 202, answer.text
            floor.until(lambda now: now.get("state") == "aborted")
        assert not floor.verdict().foreign


@pytest.mark.thorough
def test_a_database_that_is_restarted_costs_a_run_nothing(tmp_path: Path, postgres: Postgres) -> None:
    """HOLD arrives while there is no database; the run's end is in the books afterwards."""
    settings = ServerSettings(
        data=tmp_path / "data",
        database_url=postgres.url(),
        store_url=(tmp_path / "store").as_uri(),
        store_is_shared=True,
    )
    (tmp_path / "store").mkdir()
    with running_floor(tmp_path, lines=LINES, time_factor=FACTOR, settings=settings) as floor:
        floor.start()
        postgres.stop("immediate")
        try:
            floor.until_cut(_MORE)
            with contextlib.suppress(httpx.HTTPError):
                _hold(floor)
            assert floor.mill.held(), "HOLD did not arrive without the database"
            seen(lambda: floor.at_agent()["state"], lambda state: state == "held", every_s=0.1)
        finally:
            postgres.start()
        until(lambda: post(floor, "resume").status_code == 202, what="a resume once the database is back")
        require_whole(floor)


@pytest.mark.thorough
def test_a_store_that_is_away_costs_a_run_nothing(
    tmp_path: Path,
    s3_urls: Iterator[str],  # noqa: F811
    s3_address: str,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with HoldingProxy("127.0.0.1", int(s3_address.rpartition(":")[2])) as proxy:
        monkeypatch.setitem(os.environ, "AWS_ENDPOINT_URL", proxy.url)
        settings = ServerSettings(data=tmp_path / "data", store_url=next(s3_urls))
        with running_floor(tmp_path, lines=LINES, time_factor=FACTOR, settings=settings) as floor:
            floor.start()
            with proxy.away():
                floor.until_cut(_MORE)
                _hold(floor)
                assert floor.mill.held()
                floor.until_state("held")
                assert post(floor, "resume").status_code == 202
                floor.until_cut(_MORE)
            require_whole(floor)


def _hold(floor: Floor) -> None:
    """The way that the page takes: the mill's, not the run's."""
    headers = {"Authorization": f"Bearer {floor.token}"}
    address = f"{floor.url}/v1/machines/{MILL}/control/hold"
    answer = httpx.post(address, headers=headers, timeout=20.0, trust_env=False)
    assert answer.status_code == 202, answer.text


@pytest.mark.parametrize("killed", [True, False])
def test_a_stop_arrives_while_there_is_no_api(tmp_path: Path, killed: bool) -> None:
    """It is being started again, and gets no further, or it hangs. A stop comes by a token from elsewhere."""
    api, patient = "service.server.api.main", {"CAUSTICMILL_LEASE_S": "3600"}
    with running_floor(tmp_path, lines=10 * LINES, time_factor=FACTOR, server_environment=patient) as floor:
        floor.start()
        stoppers = floor.settings.data / STOPPERS
        until(lambda: hash_secret(floor.token) in read_stoppers(stoppers), what="the token in the standby's file")
        before = floor.serving.child(api)
        if killed:
            floor.kill_api()
            until(lambda: floor.serving.child(api) not in (0, before), what="another API")
        hanging = floor.serving.child(api)
        floor.serving.kill(hanging, signal.SIGSTOP)
        headers = {"Authorization": f"Bearer {floor.token}", "X-Forwarded-For": "192.0.2.1"}
        stop = f"{floor.url}/v1/machines/{MILL}/control/hold"
        answer = httpx.post(stop, headers=headers, timeout=PATIENCE_S, trust_env=False)
        assert answer.status_code == 202, answer.text
        assert floor.mill.held()
        floor.serving.kill(hanging, signal.SIGCONT)
        floor.until_state("held")
