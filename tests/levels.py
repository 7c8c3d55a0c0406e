"""Two levels: what everybody runs (`make test`), and besides what `.ci/run` does, marked `thorough`."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import pytest

THOROUGH = "CAUSTICMILL_SLOW" in os.environ
"""Whether those are run, too."""


def mostly_thorough(values: Iterable[Any], quick: Iterable[Any]) -> list[Any]:
    """For `parametrize`: only those of `quick` are run by everybody."""
    return [value if value in quick else pytest.param(value, marks=pytest.mark.thorough) for value in values]


DATABASES = mostly_thorough(("sqlite", "postgresql"), quick=("sqlite",))
"""On which the same is held."""
