"""Fixtures of tests in which something fails."""

from __future__ import annotations

from tests.service.conftest import _one_certificate  # noqa: F401 - all of them ask servers very often
