"""Jobs as lines of text: moments are those of the clock on this wall."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from service.client.jobs import when


@pytest.fixture
def _in_kolkata(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "IST-5:30")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("_in_kolkata")
@pytest.mark.parametrize(
    ("sent", "shown"),
    [
        ("2026-11-21T08:00:00.123Z", "2026-11-21 13:30:00+05:30"),
        ("2026-12-31T23:59:59.999Z", "2027-01-01 05:29:59+05:30"),
        (None, ""), ("", ""), ("never\x1b", "never?"),
    ],
)  # fmt: skip
def test_a_moment_is_local_with_its_offset(sent: str | None, shown: str) -> None:
    assert when(sent) == shown
