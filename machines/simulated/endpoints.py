"""Ends of the wire to a simulated mill: a port in the same process, on its simulated clock; and a pty or a TCP port, in
real time times a factor.

The pty and the TCP port have one loop: let simulated time catch up, hand over what is due, sleep until the next event
or byte. Idle costs nothing. A pty has no modem lines: opening it cannot pulse DTR, so `resets_on_open` works with
MemoryPort and TCP only. Replies that nobody reads are dropped when the pty's buffer is full, as by a serial chip.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
import tty
from math import inf
from pathlib import Path
from types import TracebackType

from machines.errors import PortError, PortLostError
from machines.simulated.mill import SimulatedMill

_BITS_PER_BYTE = 10  # 8N1
_LONGEST_SLEEP_S = 0.2
_SHORTEST_SLEEP_S = 0.0005
_MOST_WAITING = 65536


class MemoryPort:
    """Implements machines.port.Port. Time passes only in `read`, which ends as soon as a byte has come.

    baud : of the host's side; None: no pacing. Not the mill's: both sides read garbage
    """

    def __init__(self, mill: SimulatedMill, baud: int | None = 115200) -> None:
        self.url = "memory://mill"
        if not mill.connected:
            raise PortError(self.url, "no such port: the cable is unplugged")
        self.mill = mill
        self.wire_bytes_per_s = baud / _BITS_PER_BYTE if baud else None
        self._garbage = baud is not None and baud != mill.traits.baud
        self._cable = mill.cable
        self._woken = threading.Event()
        self._closed = False
        mill.use_wire(_BITS_PER_BYTE / baud if baud else 0.0)
        mill.pulse_dtr()

    def clock(self) -> float:
        return self.mill.now_s

    def read(self, timeout_s: float) -> bytes:
        """Return the received bytes at once; if there are none, let time pass until some come or the timeout is over
        (then b"").
        """
        mill = self.mill
        self._check()
        data = mill.output()
        if not data and not self._woken.is_set():
            mill.advance(mill.now_s + max(timeout_s, 0.0), until_output=True)
            data = mill.output()
        self._woken.clear()
        if not data:
            self._check()
        return self._noise(data) if self._garbage else data

    def write(self, data: bytes) -> None:
        self._check()
        self.mill.receive(self._noise(data) if self._garbage else data)

    def write_realtime(self, data: bytes) -> bool:
        if self._closed or self.mill.cable != self._cable or not self.mill.connected:
            return False
        self.write(data)
        return True

    def wake(self) -> None:
        self._woken.set()

    def close(self) -> None:
        self._closed = True

    def _check(self) -> None:
        if self._closed:
            raise PortError(self.url, "is closed")
        if self.mill.cable != self._cable or not self.mill.connected:
            raise PortLostError(self.url, "the device is gone (cable or power)")

    def _noise(self, data: bytes) -> bytes:
        return bytes(self.mill.chance.randrange(0x80, 0x100) if b & 1 else b ^ 0x55 for b in data)


class Endpoint:
    """A served mill. `run(stop)` serves in the caller's thread; as a context manager it has a thread of its own.

    url         : what to open: a device path, or socket://host:port
    lock        : hold it to touch the mill while it is served (press, unplug, power_cycle)
    time_factor : simulated seconds per second from now on
    """

    url: str

    def __init__(self, mill: SimulatedMill, time_factor: float) -> None:
        if not time_factor > 0:
            raise ValueError(f"time factor = {time_factor:g} is not allowed: above 0")
        self.mill = mill
        self.time_factor = time_factor
        self.lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._waiting = b""
        mill.use_wire(_BITS_PER_BYTE / mill.traits.baud)

    # -- what a kind of endpoint provides --------------------------------------------------------------------------
    def _files(self) -> list[int]:
        """Return file numbers to wait on."""
        raise NotImplementedError

    def _receive(self, ready: list[int]) -> bytes:
        raise NotImplementedError

    def _send(self, data: bytes) -> int:
        """Return how many bytes were sent; all of them if no one listens."""
        raise NotImplementedError

    def _plug(self, connected: bool) -> None:
        """Note that the mill's cable was pulled or put back."""
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    # -- the loop --------------------------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set."""
        mill = self.mill
        clock = _Clock(mill.now_s)
        plugged = True
        while not stop.is_set():
            with self.lock:
                now_s = clock.go_on(self.time_factor)
                mill.advance(now_s)
                self._waiting = (self._waiting + mill.output())[-_MOST_WAITING:]
                due_s = min(mill.next_event_s(), mill.output_s())
                if plugged != mill.connected:
                    plugged = mill.connected
                    self._plug(plugged)
            if self._waiting:
                self._waiting = self._waiting[self._send(self._waiting) :]
            sleep_s = _LONGEST_SLEEP_S if due_s == inf else (due_s - now_s) / self.time_factor
            sleep_s = min(max(sleep_s, _SHORTEST_SLEEP_S), _LONGEST_SLEEP_S)
            ready, _, _ = select.select(self._files(), [], [], sleep_s)
            if ready and (data := self._receive(ready)):
                with self.lock:
                    mill.advance(clock.go_on(self.time_factor))
                    mill.receive(data)

    def __enter__(self) -> Endpoint:
        self._thread = threading.Thread(target=self.run, args=(self._stop,), name="simulated-mill", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self.close()


class _Clock:
    """Simulated time: its pace may change, but never the time that has passed."""

    def __init__(self, now_s: float) -> None:
        self._now_s = now_s
        self._looked_s = time.monotonic()

    def go_on(self, factor: float) -> float:
        looked_s = time.monotonic()
        self._now_s += (looked_s - self._looked_s) * factor
        self._looked_s = looked_s
        return self._now_s


class _Pty(Endpoint):
    def __init__(self, mill: SimulatedMill, time_factor: float, link: Path | None) -> None:
        super().__init__(mill, time_factor)
        self._link = link
        self._master = self._slave = -1
        self._open()

    def _open(self) -> None:
        self._master, self._slave = os.openpty()  # our own slave stays open: clients may come and go
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        device = os.ttyname(self._slave)
        if self._link is not None:
            fresh = self._link.with_name(self._link.name + ".new")
            with contextlib.suppress(FileNotFoundError):
                fresh.unlink()
            fresh.symlink_to(device)
            fresh.replace(self._link)
        self.url = str(self._link) if self._link is not None else device

    def _files(self) -> list[int]:
        return [self._master] if self._master >= 0 else []

    def _receive(self, ready: list[int]) -> bytes:
        try:
            return os.read(self._master, 4096)
        except (BlockingIOError, OSError):
            return b""

    def _send(self, data: bytes) -> int:
        if self._master < 0:
            return len(data)
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return len(data)

    def _plug(self, connected: bool) -> None:
        if connected:
            self._open()
        else:
            self.close()

    def close(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
            self._master = -1
            if self._link is not None:
                self._link.unlink(missing_ok=True)


class _Tcp(Endpoint):
    def __init__(self, mill: SimulatedMill, host: str, port: int, time_factor: float) -> None:
        super().__init__(mill, time_factor)
        self._listener = socket.create_server((host, port))
        self._address = self._listener.getsockname()[:2]
        self._client: socket.socket | None = None
        self.url = f"socket://{self._address[0]}:{self._address[1]}"

    def _files(self) -> list[int]:
        files = [self._listener.fileno()] if self._listener.fileno() >= 0 else []
        return files if self._client is None else [*files, self._client.fileno()]

    def _receive(self, ready: list[int]) -> bytes:
        if self._listener.fileno() in ready:
            client, _ = self._listener.accept()
            if self._client is None:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.setblocking(False)
                self._client, self._waiting = client, b""
                with self.lock:
                    self.mill.pulse_dtr()
            else:
                client.close()  # one at a time, as a serial port
        if self._client is not None and self._client.fileno() in ready:
            try:
                data = self._client.recv(4096)
            except BlockingIOError:
                return b""
            except OSError:
                data = b""
            if data:
                return data
            self._hang_up()
        return b""

    def _send(self, data: bytes) -> int:
        if self._client is None:
            return len(data)
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return len(data)

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def _plug(self, connected: bool) -> None:
        if connected:
            self._listener = socket.create_server(self._address)
        else:
            self.close()

    def close(self) -> None:
        self._hang_up()
        self._listener.close()


def serve_pty(mill: SimulatedMill, time_factor: float = 1.0, link: Path | None = None) -> Endpoint:
    """Return a pseudo terminal; `link` is a symlink to it under a fixed name, kept valid over replugs."""
    return _Pty(mill, time_factor, link)


def serve_tcp(mill: SimulatedMill, host: str = "127.0.0.1", port: int = 0, time_factor: float = 1.0) -> Endpoint:
    """Return a TCP port (0: any free one) for one client at a time."""
    return _Tcp(mill, host, port, time_factor)
