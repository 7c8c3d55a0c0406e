"""The mill that agents of their tests have."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.service.mills import Bench, bench


@pytest.fixture
def mill() -> Iterator[Bench]:
    with bench(8.0) as found:
        yield found
