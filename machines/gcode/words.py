"""A line of a program as text: comments and blanks off, words apart. Plain Python; the compiled twin is in scan.py."""

from __future__ import annotations

import re

from machines.gcode import refusals

_WORD = re.compile(rb"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")
_BLANKS = b" \t\r\n\x0b\x0c"
_MOST_DIGITS = 17  # more do not fit a whole number of 64 bits, which the compiled scanner gathers them in


class BadTextError(Exception):
    """Text that is no block; `code` is one of refusals.py."""

    def __init__(self, code: int) -> None:
        self.code = code


def strip_block(text: bytes) -> bytes:
    """Return the block without comments and blanks, in upper case. A ( that is never closed stays, and is refused
    later.
    """
    if b";" in text or b"(" in text:
        text = _without_comments(text)
    return text.translate(None, _BLANKS).upper()


def _without_comments(text: bytes) -> bytes:
    """Remove comments: ( ends at the first ), ; at the line end; each hides the other, as in GRBL's protocol.c."""
    kept = b""
    while True:
        opening, semicolon = text.find(b"("), text.find(b";")
        if opening < 0 or 0 <= semicolon < opening:
            return kept + (text if semicolon < 0 else text[:semicolon])
        closing = text.find(b")", opening)
        if closing < 0:
            return kept + text
        kept += text[:opening]
        text = text[closing + 1 :]


def split_words(block: bytes) -> list[tuple[bytes, bytes]]:
    """Return letters and numbers of a stripped block. BadTextError where something is neither."""
    words: list[tuple[bytes, bytes]] = _WORD.findall(block)
    if sum(len(number) for _, number in words) + len(words) != len(block):
        raise BadTextError(_what_is_wrong(block))
    for _, number in words:
        if len(number) > _MOST_DIGITS and sum(48 <= c <= 57 for c in number) > _MOST_DIGITS:
            raise BadTextError(refusals.NO_NUMBER)
    return words


def _what_is_wrong(block: bytes) -> int:
    """Return the refusal code of the first place that is no word."""
    at = 0
    while match := _WORD.match(block, at):
        at = match.end()
    return _AT_START.get(block[at : at + 1], refusals.NO_NUMBER if block[at : at + 1].isalpha() else refusals.NO_LETTER)


_AT_START = {
    b"(": refusals.OPEN_COMMENT,
    b"%": refusals.PERCENT,
    b"$": refusals.DOLLAR,
    b"/": refusals.BLOCK_DELETE,
}


def strip_ends(text: bytes) -> bytes:
    """Return a line of another language than G-code as it stands, without the blanks and the tape's end marks around
    it.
    """
    return text.strip(b" \t\r\n\x0b\x0c\x1a\x00")


def shown(text: bytes) -> str:
    """Return a line as a message shows it: printable characters on one line, at most 100 of them."""
    plain = "".join(chr(c) if 32 <= c < 127 else f"\\x{c:02x}" for c in text.strip()[:100].replace(b"\t", b" "))
    return plain if len(plain) <= 100 else plain[:97] + "..."
