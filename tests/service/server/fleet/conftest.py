"""A shop with one mill for each test; its agents end with the test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.server.fleet.agent_launcher import start_agents
from tests.service.mills import Bench, bench
from tests.service.server.fleet.shop import Shop, kill_agents, own_folders, shop, write_profile


@pytest.fixture
def mill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """A simulated mill and a profile that says where it is."""
    own_folders(monkeypatch, tmp_path)
    with bench(8.0) as found:
        write_profile(found.url)
        try:
            yield found
        finally:
            kill_agents(tmp_path)


@pytest.fixture
def floor(tmp_path: Path, mill: Bench) -> Iterator[Shop]:
    with shop(tmp_path / "data", mill) as found:
        yield found


@pytest.fixture
def floor_of_processes(tmp_path: Path, mill: Bench) -> Iterator[Shop]:
    """With an agent that can be killed."""
    with shop(tmp_path / "data", mill, start=start_agents) as found:
        yield found
