"""Echo check: what the controller has read against what was sent, where its firmware echoes lines."""

from __future__ import annotations


def as_read(text: bytes) -> bytes:
    """A block as GRBL's reader keeps it: no blanks, upper case (comments are never sent)."""
    return text.replace(b" ", b"").upper()


def differs(sent: bytes, echoed: bytes) -> bool:
    """The controller has read another line than was sent."""
    if sent == echoed:
        return False
    return as_read(sent) != as_read(echoed)
