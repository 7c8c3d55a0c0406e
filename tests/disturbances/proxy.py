"""A TCP proxy between two parts of the system that holds bytes back: what a network does on a bad day.

It changes nothing and sends nothing twice. What it does with bytes is set for each direction and holds for connections
that are open and for those that come.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal, Self

from tests.waiting import until

Direction = Literal["there", "back"]
_PIECE = 65536


@dataclass
class _Way:
    """One direction: bytes pass, wait, or are swallowed. `carried` counts those that arrived at the proxy."""

    delay_s: float = 0.0
    held: bool = False
    dropped: bool = False
    carried: int = 0
    change: asyncio.Event = field(default_factory=asyncio.Event)


class HoldingProxy:
    """Listens at `url`, passes on to the address given. Its methods may be called from any thread.

    there : from who connects to the address; back: the answers
    """

    def __init__(self, host: str, port: int) -> None:
        self._target = (host, port)
        self._ways: dict[Direction, _Way] = {}
        self._open: set[asyncio.StreamWriter] = set()
        self._refusing = False
        self._loop = asyncio.new_event_loop()
        self._began = threading.Event()
        self._thread = threading.Thread(target=self._run, name="proxy", daemon=True)
        self.port = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self._thread.start()
        self._began.wait()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def carried(self, way: Direction) -> int:
        """Bytes that have come to the proxy on this way, passed on or not."""
        return self._ways[way].carried

    def delay(self, way: Direction, seconds: float) -> None:
        """From now on each byte of this way comes so much later."""
        self._set(way, delay_s=seconds)

    @contextlib.contextmanager
    def hold(self, way: Direction) -> Iterator[None]:
        """Bytes of this way wait while the block runs and go on after it."""
        self._set(way, held=True)
        try:
            yield
        finally:
            self._set(way, held=False)

    @contextlib.contextmanager
    def drop(self, way: Direction) -> Iterator[None]:
        """Bytes of this way are lost while the block runs; the connections on which some were are cut at its end."""
        self._set(way, dropped=True)
        try:
            yield
        finally:
            self._set(way, dropped=False)
            self.cut()

    @contextlib.contextmanager
    def away(self) -> Iterator[None]:
        """Every connection is cut and none is taken while the block runs."""
        self._refusing = True
        self.cut()
        try:
            yield
        finally:
            self._refusing = False

    def cut(self) -> None:
        """Every open connection ends; new ones may come."""
        self._call(self._abort)

    def until_carried(self, way: Direction, more: int) -> None:
        """Wait until so many bytes are there: a request that is held back has arrived at the proxy."""
        until(lambda: self.carried(way) >= more, what=f"{more} bytes on the way {way}")

    # ------------------------------------------------------------------ in the proxy's own thread

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._ways = {"there": _Way(), "back": _Way()}
        server = self._loop.run_until_complete(asyncio.start_server(self._connected, "127.0.0.1", 0, backlog=1024))
        self.port = server.sockets[0].getsockname()[1]
        self._began.set()
        self._loop.run_forever()
        server.close()
        self._abort()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        with contextlib.suppress(RuntimeError):
            self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    def _set(self, way: Direction, **values: object) -> None:
        def change() -> None:
            one = self._ways[way]
            for name, value in values.items():
                setattr(one, name, value)
            one.change.set()
            one.change = asyncio.Event()

        self._call(change)

    def _call(self, function: Callable[[], None]) -> None:
        """Carried out by the time that this returns."""
        done = threading.Event()
        self._loop.call_soon_threadsafe(lambda: (function(), done.set()))
        done.wait()

    def _abort(self) -> None:
        for writer in list(self._open):
            writer.transport.abort()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._refusing:
            writer.transport.abort()
            return
        ends = {writer}
        self._open.add(writer)  # before it is connected: it may be cut by then
        try:
            far_reader, far_writer = await asyncio.open_connection(*self._target)
            ends.add(far_writer)
            self._open.add(far_writer)
            if not writer.transport.is_closing():
                await asyncio.gather(
                    self._carry(reader, far_writer, self._ways["there"]),
                    self._carry(far_reader, writer, self._ways["back"]),
                )
        except OSError:  # nobody listens there
            pass
        finally:
            self._open -= ends
            for end in ends:
                end.transport.abort()

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, way: _Way) -> None:
        """Pieces arrive in their order, each as late as the way is slow; the end of the stream is one of them."""
        pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

        async def take() -> None:
            data = b"?"
            while data:
                try:
                    data = await reader.read(_PIECE)
                except OSError:
                    data = b""
                way.carried += len(data)
                pieces.put_nowait((self._loop.time(), data))

        async def give() -> None:
            while True:
                at_s, data = await pieces.get()
                await self._until_passing(way, at_s)
                if not data:
                    break
                if not way.dropped:
                    writer.write(data)
                    await writer.drain()
            if writer.can_write_eof():
                writer.write_eof()

        with contextlib.suppress(OSError):
            await _both(take, give)

    async def _until_passing(self, way: _Way, at_s: float) -> None:
        while way.held or (left_s := at_s + way.delay_s - self._loop.time()) > 0:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(way.change.wait(), None if way.held else left_s)


async def _both(*works: Callable[[], Awaitable[None]]) -> None:
    async with asyncio.TaskGroup() as group:
        for work in works:
            group.create_task(work())  # type: ignore[arg-type]
