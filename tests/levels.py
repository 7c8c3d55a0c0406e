"""Two levels: what everybody runs (`make test`), and besides what `.ci/run` does, marked `thorough`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def mostly_thorough(values: Iterable[Any], quick: Iterable[Any]) -> list[Any]:
    """For `parametrize`: only those of `quick` are run by everybody."""
    return [value if value in quick else pytest.param(value, marks=pytest.mark.thorough) for value in values]
