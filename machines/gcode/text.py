"""A program as text: checks that it is plain text with line ends that every control reads, strips comments and blanks
from a line, and splits it into words. Plain Python; the compiled twin is in scan.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from machines.errors import ProgramRefusedError
from machines.gcode import refusals
from phrases.phrase import Phrase

_UTF8_MARK = b"\xef\xbb\xbf"
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
_LOOKED_AT = 64
_LONE_RETURN = re.compile(rb"\r(?=[^\r\n])")
_WORD = re.compile(rb"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")
_BLANKS = b" \t\r\n\x0b\x0c"
_MOST_DIGITS = 17  # more do not fit the 64-bit integer in which the compiled scanner gathers them

_AT_START = {
    b"(": refusals.OPEN_COMMENT,
    b"%": refusals.PERCENT,
    b"$": refusals.DOLLAR,
    b"/": refusals.BLOCK_DELETE,
}


def require_plain_text(chunks: Iterable[bytes], *, lone_returns: bool = False) -> Iterator[bytes]:
    """Yield the same pieces of a file. Raise ProgramRefusedError, which names the encoding, if it is not plain text.

    lone_returns : CR alone may end a line: the language separates commands by another character
    """
    line, last = 1, b""
    for number, chunk in enumerate(chunks):
        if number == 0 and (words := _name_encoding(chunk[:_LOOKED_AT])):
            raise ProgramRefusedError(1, show_line(chunk[:_LOOKED_AT]), words)
        text = last + chunk if last == b"\r" else chunk
        if not lone_returns and text.count(b"\r") != text.count(b"\r\n") and (found := _LONE_RETURN.search(text)):
            at = line + text.count(b"\n", 0, found.start())
            raise ProgramRefusedError(
                at,
                show_line(text[text.rfind(b"\n", 0, found.start()) + 1 : found.start()]),
                Phrase(
                    "the line ends with CR alone, as on old Macintoshes: a control would begin a new line there, other "
                    "readers do not; save the file with LF or CR LF line ends"
                ),
            )
        line += chunk.count(b"\n")
        last = chunk[-1:]
        yield chunk


def _name_encoding(beginning: bytes) -> Phrase | None:
    every_second_is_zero = len(beginning) >= 4 and (not any(beginning[::2]) or not any(beginning[1::2]))
    if beginning.startswith(_UTF16_MARKS) or every_second_is_zero:
        return Phrase(
            "the file is text in UTF-16, two bytes a letter; save it as plain text (ASCII, or UTF-8 without BOM)"
        )
    if beginning.startswith(_UTF8_MARK):
        return Phrase(
            "the file begins with a byte order mark (UTF-8 with BOM); save it as UTF-8 without BOM, or as ASCII"
        )
    return None


class BadTextError(Exception):
    """Text that is not a block; `code` is one of refusals.py."""

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
    """Remove comments: ( ends at the first ), ; at the line end. Inside one kind the other has no effect, as in GRBL's
    protocol.c.
    """
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
    """Return the letters and numbers of a stripped block. BadTextError if a part is neither."""
    words: list[tuple[bytes, bytes]] = _WORD.findall(block)
    if sum(len(number) for _, number in words) + len(words) != len(block):
        raise BadTextError(_what_is_wrong(block))
    for _, number in words:
        if len(number) > _MOST_DIGITS and sum(48 <= c <= 57 for c in number) > _MOST_DIGITS:
            raise BadTextError(refusals.NO_NUMBER)
    return words


def _what_is_wrong(block: bytes) -> int:
    """Return the refusal code of the first part that is not a word."""
    at = 0
    while match := _WORD.match(block, at):
        at = match.end()
    return _AT_START.get(block[at : at + 1], refusals.NO_NUMBER if block[at : at + 1].isalpha() else refusals.NO_LETTER)


def strip_ends(text: bytes) -> bytes:
    """Return a line of a language other than G-code unchanged, except that blanks and tape end marks around it are
    removed.
    """
    return text.strip(b" \t\r\n\x0b\x0c\x1a\x00")


def show_line(text: bytes) -> str:
    """Return a line as a message shows it: printable characters on one line, at most 100 of them."""
    plain = "".join(chr(c) if 32 <= c < 127 else f"\\x{c:02x}" for c in text.strip()[:100].replace(b"\t", b" "))
    return plain if len(plain) <= 100 else plain[:97] + "..."
