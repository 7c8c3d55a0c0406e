"""What the tests of the mill's owner share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from tests.machines.shop import LINES, Shop
from tests.trials import kill_trial as trial


@pytest.fixture(scope="session")
def kill_trial() -> ModuleType:
    """The bench and the trials in which the owner of a mill dies."""
    return trial


@pytest.fixture
def shop(tmp_path: Path, kill_trial: ModuleType) -> Iterator[Shop]:
    made = Shop(tmp_path, kill_trial, LINES)
    yield made
    made.mill.close(detach=True)
