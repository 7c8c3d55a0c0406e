"""`serve --with-simulated-mill`: a mill to try everything on, which lives and ends with the server."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.cli.main import run
from tests.service.server.supervisor.processes import Serving, descendants, is_alive, offer_code, served
from tests.waiting import PATIENCE_S, until

HERE = "/v1/machines/simulated"
MILL, AGENT = "service.server.supervisor.simulated_mill", "service.server.supervisor.simulated_agent"


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Serving, httpx.Client]]:
    """A server with a simulated mill, and a paired page, which has control."""
    folder = tmp_path_factory.mktemp("workshop")
    config = {"CAUSTICMILL_CONFIG_DIR": str(folder / "config")}
    with served("--no-worker", "--with-simulated-mill", data=folder / "data", **config) as serving:
        _tables(folder / "data")
        serving.until_ready()
        with httpx.Client(base_url=serving.url, timeout=PATIENCE_S) as client:
            given = {"code": offer_code(folder / "data"), "name": "Ada"}
            token = client.post("/v1/pairings", json=given).json()["token"]
            client.headers["Authorization"] = f"Bearer {token}"
            until(lambda: mill(client)["state"] == "alarm", what="a mill")
            control = client.post(f"{HERE}/control", json={"operator": "Ada"}).json()["control"]
            client.headers["Causticmill-Control"] = control
            yield serving, client


def _tables(data: Path) -> None:
    """As a worker makes them, whom this server does not have."""
    assert run(["token", "list", "--data", str(data)]) == 0


def mill(client: httpx.Client) -> dict[str, Any]:
    return dict(client.get(HERE).json()["mill"] or {"state": "away"})


def order(client: httpx.Client, what: str, **body: Any) -> None:
    """A controller that still answers the order before refuses the next: the person tries again."""
    client.post(f"{HERE}/control", json={"operator": "Ada"})

    def taken() -> bool:
        grant = {"Causticmill-Grant": client.post(f"{HERE}/grants", json={}).json()["grant"]}
        answer = client.post(f"{HERE}/control/{what}", json=body, headers=grant)
        assert answer.status_code == 202 or "busy" in answer.text, answer.text
        return answer.status_code == 202

    until(taken, what=what)


def until_idle(client: httpx.Client) -> None:
    until(lambda: mill(client)["state"] == "idle", what="idle")


def test_it_says_that_it_is_simulated_and_begins_locked(workshop: tuple[Serving, httpx.Client]) -> None:
    _, client = workshop
    seen = client.get(HERE).json()
    assert seen["simulated"] and seen["profile"]["homing"]
    assert seen["profile"]["description"] == "a simulated mill, 20 times as fast as a real one"
    assert mill(client)["state"] == "alarm"


def test_it_is_homed_jogged_and_probed_like_a_mill(workshop: tuple[Serving, httpx.Client]) -> None:
    """Far enough from its ends for a lens of 100 mm with its margin."""
    _, client = workshop
    order(client, "home")
    until_idle(client)
    assert mill(client)["machine_mm"] == [-1, -1, -1] and mill(client)["position_trusted"]
    order(client, "jog", by_mm=[-199, -199, -20], feed_mm_per_min=5000)
    until(lambda: mill(client)["machine_mm"] == [-200, -200, -21], what="arrival")
    until_idle(client)
    order(client, "zero", axes="XY")
    until_idle(client)
    order(client, "probe", depth_mm=20, feed_mm_per_min=200, retract_mm=2)
    until(lambda: abs(mill(client)["work_mm"][2] - 2) < 0.01, what="a touch and two millimetres up")
    assert mill(client)["work_mm"][:2] == [0, 0] and mill(client)["machine_mm"][2] == pytest.approx(-28, abs=0.02)


@pytest.mark.thorough
def test_the_corner_of_its_block_is_probed(workshop: tuple[Serving, httpx.Client]) -> None:
    """A plate stands at machine -210, -210, -30; X0 Y0 lies inside the block's edges, Z0 under the plate."""
    _, client = workshop
    order(client, "home")
    until_idle(client)
    order(client, "jog", by_mm=[-199, -199, -20], feed_mm_per_min=5000)
    until(lambda: mill(client)["machine_mm"] == [-200, -200, -21], what="arrival")
    until_idle(client)
    plate = {"depth_mm": 20, "plate_mm": 10, "wall_x_mm": 6, "wall_y_mm": 4, "cutter_radius_mm": 1.5, "margin_mm": 8}
    order(client, "probe-corner", **plate, feed_mm_per_min=1000)
    expected = pytest.approx([-200 - (-210 + 6 + 8), -200 - (-210 + 4 + 8), 10 + 5], abs=0.01)
    until(lambda: mill(client)["work_mm"] == expected, what="a zero by three touches, from where it began")


@pytest.mark.thorough
def test_a_mill_that_is_gone_comes_back_switched_off_and_on(workshop: tuple[Serving, httpx.Client]) -> None:
    serving, client = workshop
    serving.kill(serving.child(MILL))
    until(lambda: mill(client)["state"] == "alarm", what="a mill after its power came back")
    assert not mill(client)["position_trusted"]


@pytest.mark.thorough
def test_a_server_that_is_killed_in_the_middle_leaves_mill_and_control_as_they_are(
    workshop: tuple[Serving, httpx.Client],
) -> None:
    serving, client = workshop
    before, holder = serving.child(MILL), client.get(HERE).json()["control"]
    serving.kill(serving.child("service.server.api.main"))
    until(lambda: _answers(client), what="the next API")
    assert serving.child(MILL) == before and client.get(HERE).json()["control"] == holder


def _answers(client: httpx.Client) -> bool:
    try:
        return client.get(HERE).status_code == 200
    except httpx.HTTPError:
        return False


def test_nothing_of_it_is_left_when_the_server_ends(workshop: tuple[Serving, httpx.Client]) -> None:
    """Runs last. Agents of real mills stay; this one has nothing to watch over."""
    serving, _ = workshop
    below = descendants(serving.pid)
    assert serving.child(AGENT) and serving.child(MILL)
    serving.kill(serving.pid, signal.SIGTERM)
    assert serving.ended() == 0
    assert not any(map(is_alive, below))


def test_a_persons_own_mill_of_that_name_is_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from service.server.fleet.registry import read_machines
    from service.settings import ServerSettings

    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    (tmp_path / "machines").mkdir()
    (tmp_path / "machines/simulated.toml").write_text('extends = "grbl"\n[link]\nport = "/dev/ttyUSB0"\n')
    known, problems = read_machines(ServerSettings(data=tmp_path / "data", simulated_mill=True))
    assert not known["simulated"].simulated and "simulated" in problems[0]
    assert "simulated" not in read_machines(ServerSettings(data=tmp_path / "data"))[0] or problems
