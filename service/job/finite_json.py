"""Figures as report.json takes them."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any


def plain(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same figures with null in place of what is infinite or unknown, which JSON cannot say."""
    return {key: _value(value) for key, value in record.items()}


def _value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return plain(value)
    if isinstance(value, list | tuple):
        return [_value(each) for each in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def table(value: Any) -> Mapping[str, Any]:
    """Return a part of the report or of the spec; an empty one where there is none."""
    return value if isinstance(value, Mapping) else {}
