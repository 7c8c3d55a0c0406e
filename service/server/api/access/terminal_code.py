"""The code for pairing pages, printed again where a person looks for it: on the terminal that the server runs in.

Never where stderr is a file or a pipe: what stands there is stored and shipped, and a code opens a mill.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable
from typing import TextIO

from service.server.database.pairing import PairingBook
from service.server.pairing_code import code_lines, code_of, new_offer

_SELDOM_S = 5.0  # a page that guesses must not flood the terminal


class CodeOnTerminal:
    """offer: the one whose code was printed at the start. url: of the page. For any thread."""

    def __init__(
        self,
        pairings: PairingBook,
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
        """Print a code that is taken, a new one where the old one has ended. False: there is no terminal."""
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
