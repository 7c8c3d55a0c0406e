"""The line between the API and its standby: which of them accepts connections, and the hand-over of connections.

Theory of operation. Both have the listening socket. The API says SERVING twice a second as long as its event loop
turns. The standby accepts connections when it has not heard that for a while, and at once when the supervisor, or an
API that ends, says GONE. It serves stops itself. It hands all other connections, with the bytes already read, to the
API as soon as that serves: a caller waits while the API starts, and is not refused. Both may accept for a moment
without harm.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable

from service.processes.lifeline import LINE_BYTES, SERVING

_SILENCE_S = 2.0
_AGAIN_S = 0.02


class ApiWatch:
    """The standby's end. on_change(serves) is called when the API begins or stops serving."""

    def __init__(self, line: socket.socket, on_change: Callable[[bool], None]) -> None:
        self._line = line
        self._on_change = on_change
        self._loop = asyncio.get_running_loop()
        self._serves = asyncio.Event()
        self._silence: asyncio.TimerHandle | None = None
        self._loop.add_reader(line, self._read)

    async def hand_over(self, connection: int, received: bytes, within_s: float) -> bool:
        """Hand a connection to the API when it serves; return whether it did in time."""
        if len(received) > LINE_BYTES:
            return False
        with contextlib.suppress(TimeoutError, OSError):
            async with asyncio.timeout(within_s):
                while True:
                    await self._serves.wait()
                    with contextlib.suppress(BlockingIOError):
                        socket.send_fds(self._line, [received], [connection])
                        return True
                    await asyncio.sleep(_AGAIN_S)
        return False

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while word := self._line.recv(64):
                self._hear(word == SERVING)

    def _hear(self, serves: bool) -> None:
        if self._silence is not None:
            self._silence.cancel()
        self._silence = self._loop.call_later(_SILENCE_S, self._hear, False) if serves else None
        if serves != self._serves.is_set():
            (self._serves.set if serves else self._serves.clear)()
            self._on_change(serves)


def receive_connections(line: socket.socket, begin: Callable[[socket.socket, bytes], None]) -> None:
    """Call `begin`, from now on, with every connection that the standby hands over. For the API's end of the line."""

    def read() -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                received, descriptors, _, _ = socket.recv_fds(line, LINE_BYTES, 1)
                for descriptor in descriptors:
                    begin(socket.socket(fileno=descriptor), received)

    asyncio.get_running_loop().add_reader(line, read)
