"""How these files begin: one line of JSON, padded so that the arrays behind it lie on multiples of 8 bytes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

_ALIGN = 8


def header_line(facts: Mapping[str, Any]) -> bytes:
    """Return the facts as one line; spaces before its end make its length a multiple of 8."""
    text = json.dumps(facts, separators=(",", ":"), allow_nan=False).encode()
    return text + b" " * (-(len(text) + 1) % _ALIGN) + b"\n"


def split_header(data: bytes) -> tuple[dict[str, Any], int]:
    """Return the facts at the beginning of a file, and where its arrays begin."""
    end = data.index(b"\n") + 1
    facts: dict[str, Any] = json.loads(data[:end])
    return facts, end
