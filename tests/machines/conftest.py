"""The harness of the kill trials, loaded by path: the test folders are no packages."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def kill_trial() -> ModuleType:
    spec = importlib.util.spec_from_file_location("kill_trial", Path(__file__).with_name("kill_trial.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["kill_trial"] = module
    spec.loader.exec_module(module)
    return module
