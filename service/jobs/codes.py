"""Codes for pairing a page, as they are made, printed and typed. Only the standard library: the supervisor makes them.

Twelve characters of Crockford's base 32: sixty random bits. What is typed may be small letters, with any blanks and
dashes, and with O for 0 and I or L for 1, which the alphabet therefore leaves out.
"""

from __future__ import annotations

import re
import secrets

ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
_LENGTH = 12
_MEANT = str.maketrans("OIL", "011")


def new_offer() -> str:
    """A new code with an id, as one text: ID:7K3D-0QXM-91TZ."""
    return f"{secrets.token_hex(16)}:{_group(''.join(secrets.choice(ALPHABET) for _ in range(_LENGTH)))}"


def code_of(offer: str) -> str:
    """What a person types."""
    return offer.rpartition(":")[2]


def read_code(typed: str) -> str:
    """What a person has typed, spelled as codes are printed."""
    return _group(re.sub(r"[\s-]", "", typed).upper().translate(_MEANT))


def _group(text: str) -> str:
    return "-".join(text[at : at + 4] for at in range(0, len(text), 4))
