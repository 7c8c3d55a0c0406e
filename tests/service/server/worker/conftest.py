"""Stage processes for a test, which leave nothing behind."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.server.worker.stage_bench import HERE, Bench, fork_servers


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("PYTHONPATH", str(HERE / "entries"))
    made = Bench(tmp_path)
    yield made
    made.processes.close()
    assert fork_servers() == []


@pytest.fixture
def computing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """With stages that compute, and room for the threads' own address space."""
    monkeypatch.setenv("PYTHONPATH", str(HERE / "entries"))
    made = Bench(tmp_path, "array_stages:run", stage_memory_mb=2000)
    yield made
    made.processes.close()
    assert fork_servers() == []
