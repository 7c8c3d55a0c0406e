"""Requires a program to be plain text with line ends that every control reads."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from machines.errors import ProgramRefusedError
from machines.gcode.words import shown
from phrases.phrase import Phrase

_UTF8_MARK = b"\xef\xbb\xbf"
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
_LOOKED_AT = 64
_LONE_RETURN = re.compile(rb"\r(?=[^\r\n])")


def require_plain_text(chunks: Iterable[bytes], *, lone_returns: bool = False) -> Iterator[bytes]:
    """Yield the same pieces of a file. Raise ProgramRefusedError, which names the encoding, if it is not plain text.

    lone_returns : CR alone may end a line: the language separates commands by another character
    """
    line, last = 1, b""
    for number, chunk in enumerate(chunks):
        if number == 0 and (words := _name_encoding(chunk[:_LOOKED_AT])):
            raise ProgramRefusedError(1, shown(chunk[:_LOOKED_AT]), words)
        text = last + chunk if last == b"\r" else chunk
        if not lone_returns and text.count(b"\r") != text.count(b"\r\n") and (found := _LONE_RETURN.search(text)):
            at = line + text.count(b"\n", 0, found.start())
            raise ProgramRefusedError(
                at,
                shown(text[text.rfind(b"\n", 0, found.start()) + 1 : found.start()]),
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
