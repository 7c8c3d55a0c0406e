"""Codes for pairing a page: makes, prints and reads them. Imports only the standard library, because the supervisor
uses it.

Twelve characters of Crockford's base 32: sixty random bits. A typed code may have small letters, blanks, dashes, O for
0, and I or L for 1; the alphabet has none of these three letters.
"""

from __future__ import annotations

import contextlib
import re
import secrets
import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol, TextIO

ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
_LENGTH = 12
_MEANT = str.maketrans("OIL", "011")


def new_offer() -> str:
    """Make a new code with an id, as one text: ID:7K3D-0QXM-91TZ."""
    return f"{secrets.token_hex(16)}:{_group(''.join(secrets.choice(ALPHABET) for _ in range(_LENGTH)))}"


def code_of(offer: str) -> str:
    """Return the code of an offer, as a person types it."""
    return offer.rpartition(":")[2]


def read_code(typed: str) -> str:
    """Return a typed code in the spelling of printed codes."""
    return _group(re.sub(r"[\s-]", "", typed).upper().translate(_MEANT))


def _group(text: str) -> str:
    return "-".join(text[at : at + 4] for at in range(0, len(text), 4))


_FINE, _PLAIN = tuple("┌─┐│└┘"), tuple("+-+|++")


def code_lines(stream: TextIO, url: str, code: str) -> str:
    """Return lines with the page's address and the code for running mills from it. For a terminal only."""
    rows = (f"Open  {url}  in a browser.", f"Code  {code}   (the page asks for it before it runs a mill)")
    return frame_rows(rows, fine=(stream.encoding or "").lower().replace("-", "") == "utf8")


def frame_rows(rows: tuple[str, ...], *, fine: bool) -> str:
    """Return rows in a box with an empty line before and after it."""
    left_top, across, right_top, down, left, right = _FINE if fine else _PLAIN
    width = max(map(len, rows)) + 4
    inner = (f"{down}  {row:<{width - 4}}  {down}" for row in rows)
    return "\n".join(("", left_top + across * width + right_top, *inner, left + across * width + right, "", ""))


_SELDOM_S = 5.0  # a page that guesses must not flood the terminal


class Offers(Protocol):
    """The codes that are valid (`database/pairing`)."""

    def is_live(self, offer: str) -> bool: ...

    def offer(self, offer: str) -> None: ...


class CodeOnTerminal:
    """Prints the code again on the terminal of the server, where a person looks for it.

    Never if stderr is a file or a pipe: these are stored and passed on, and a code gives access to a mill.

    offer: that of the code printed at the start. url: of the page. For any thread.
    """

    def __init__(
        self,
        pairings: Offers,
        offer: str,
        url: str,
        *,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pairings = pairings
        self._offer = offer
        self._url = url
        self._stream = stream if stream is not None else sys.stderr
        self._clock = clock
        self._lock = threading.Lock()
        self._shown_at = float("-inf")

    def show(self) -> bool:
        """Print a valid code, a new one if the old one has expired. False: there is no terminal."""
        if not (self._offer and self._stream.isatty()):
            return False
        with self._lock:
            if self._clock() < self._shown_at + _SELDOM_S:
                return True
            self._shown_at = self._clock()
            if not self._pairings.is_live(self._offer):
                self._offer = new_offer()
                self._pairings.offer(self._offer)
            with contextlib.suppress(OSError):
                self._stream.write(code_lines(self._stream, self._url, code_of(self._offer)))
                self._stream.flush()
        return True
