"""The acceptor: once paused it accepts nothing, even if it had run out of file descriptors just before."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable

import pytest

from service.http.acceptor import Acceptor


class _FullListener:
    """A listener of a process that has no file descriptor left."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self.listened = 0

    def fileno(self) -> int:
        return self._listener.fileno()

    def setblocking(self, flag: bool) -> None:
        self._listener.setblocking(flag)

    def listen(self, backlog: int) -> None:
        self.listened += 1
        self._listener.listen(backlog)

    def accept(self) -> tuple[socket.socket, object]:
        raise OSError(errno.EMFILE, "too many open files")


@pytest.mark.parametrize("end", [Acceptor.pause, Acceptor.close])
def test_it_does_not_resume_by_itself_after_it_was_paused(end: Callable[[Acceptor], None]) -> None:
    async def run() -> None:
        with socket.socket() as real:
            real.bind(("127.0.0.1", 0))
            listener = _FullListener(real)
            acceptor = Acceptor(listener, lambda _: None, silent=10, wait_s=30.0)  # type: ignore[arg-type]
            acceptor._accept()  # no descriptor is left: it tries again in a moment
            end(acceptor)
            loop, over = asyncio.get_running_loop(), asyncio.Event()
            loop.call_later(0.2, over.set)  # later than that moment, on the same clock
            await over.wait()
            assert listener.listened == 1
            if end is Acceptor.pause:
                acceptor.close()

    asyncio.run(run())
