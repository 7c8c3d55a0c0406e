"""Accepts connections and sets them up; those whose first bytes name a stop come first.

Theory of operation. Setting up a connection takes half a millisecond, accepting it a fiftieth of that. So the acceptor
accepts all connections, and waits for their first bytes at no further cost. In each turn of the event loop it sets up
every stop and a few of the others: a crowd of three thousand delays a stop by less than a tenth of a second.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import selectors
import socket
from collections import deque
from collections.abc import Callable
from urllib.parse import unquote

from service.http.admission import is_stop

_QUEUED = 4096  # connections that the system queues for us; the client of a dropped one tries again after a second
_AT_ONCE = 128  # accepted in one turn
_BEGUN_AT_ONCE = 4
_MOST_SPEAKING = 1000
_HEAD_BYTES = 4096
_AGAIN_S = 0.05
_REQUEST_LINE = re.compile(rb"([A-Z]+) ([^ ?]+)[^ ]* HTTP/1")


class Acceptor:
    """Accepts the connections of one listener. For one event loop.

    begin   : sets a connection up
    silent  : most connections that have sent nothing yet; beyond that the oldest is closed
    wait_s  : for the first byte
    """

    def __init__(
        self, listener: socket.socket, begin: Callable[[socket.socket], None], *, silent: int, wait_s: float
    ) -> None:
        self._listener = listener
        self._begin = begin
        self._most_silent = silent
        self._wait_s = wait_s
        self._loop = asyncio.get_running_loop()
        self._silent: dict[socket.socket, asyncio.TimerHandle] = {}
        self._speaking: deque[socket.socket] = deque()
        self._heard = selectors.DefaultSelector()
        self._resuming: asyncio.TimerHandle | None = None
        listener.setblocking(False)
        self._loop.add_reader(self._heard, self._hear)
        self.resume()

    def resume(self) -> None:
        """Accept connections."""
        self._resuming = None
        self._listener.listen(_QUEUED)
        self._loop.add_reader(self._listener, self._accept)

    def pause(self) -> None:
        """Stop accepting; set up the connections accepted so far. The listener stays open."""
        self._loop.remove_reader(self._listener)
        if self._resuming is not None:
            self._resuming.cancel()

    def close(self) -> None:
        """Stop accepting, and close the connections that have not been set up."""
        self.pause()
        self._loop.remove_reader(self._heard)
        for connection in [*self._silent, *self._speaking]:
            self._lose(connection)
        self._speaking.clear()
        self._heard.close()

    def _accept(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                connection, _ = self._listener.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError:  # too many open files
                self._lose_oldest()
                self.pause()
                self._resuming = self._loop.call_later(_AGAIN_S, self.resume)
                return
            connection.setblocking(False)
            self._silent[connection] = self._loop.call_later(self._wait_s, self._lose, connection)
            self._heard.register(connection, selectors.EVENT_READ)
            if len(self._silent) > self._most_silent:
                self._lose_oldest()

    def _hear(self) -> None:
        """Set up the stops among connections that have sent something; queue the others, and those that have closed."""
        for key, _ in self._heard.select(0):
            connection = key.fileobj
            assert isinstance(connection, socket.socket)
            self._heard.unregister(connection)
            self._silent.pop(connection).cancel()
            with contextlib.suppress(OSError):
                if _names_stop(connection.recv(_HEAD_BYTES, socket.MSG_PEEK)):
                    self._begin(connection)
                    continue
            self._speaking.append(connection)
            if len(self._speaking) > _MOST_SPEAKING:
                self._speaking.popleft().close()
            if len(self._speaking) == 1:
                self._loop.call_soon(self._begin_some)

    def _begin_some(self) -> None:
        for _ in range(min(_BEGUN_AT_ONCE, len(self._speaking))):
            self._begin(self._speaking.popleft())
        if self._speaking:
            self._loop.call_soon(self._begin_some)

    def _lose_oldest(self) -> None:
        if self._silent:
            self._lose(next(iter(self._silent)))

    def _lose(self, connection: socket.socket) -> None:
        if (timer := self._silent.pop(connection, None)) is not None:
            timer.cancel()
            self._heard.unregister(connection)
        connection.close()


def _names_stop(head: bytes) -> bool:
    """Return whether the beginning of a request names a stop. An incomplete first line does not."""
    found = _REQUEST_LINE.match(head)
    return found is not None and is_stop(found[1].decode("ascii"), unquote(found[2].decode("latin-1")))
