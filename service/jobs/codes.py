"""Codes for pairing a page, as they are made and printed. Only the standard library: the supervisor makes them, too."""

from __future__ import annotations

import secrets


def new_offer() -> str:
    """A new code with an id, as one text: ID:1234-5678."""
    number = secrets.randbelow(10**8)
    return f"{secrets.token_hex(16)}:{number // 10_000:04}-{number % 10_000:04}"


def code_of(offer: str) -> str:
    """What a person types."""
    return offer.rpartition(":")[2]
