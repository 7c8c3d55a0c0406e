"""The descriptors that a child of `serve` inherits from its supervisor: a pipe for heartbeats, the bound socket to
serve, and the line between API and standby.

The pipe works both ways: without heartbeats the supervisor considers the child frozen, and a supervisor that has ended
closes it. Only the standard library is imported here.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import threading
from collections.abc import Callable

from service.processes.linux import die_with_parent

BEAT_FD = "CAUSTICMILL_BEAT_FD"
LISTEN_FD = "CAUSTICMILL_LISTEN_FD"
LINE_FD = "CAUSTICMILL_LINE_FD"
SUPERVISOR = "CAUSTICMILL_SUPERVISOR"
PAIRING_OFFER = "CAUSTICMILL_PAIRING_OFFER"
BEAT_S = 0.5
SERVING, GONE = b"serving", b"gone"  # messages on the line between API and standby
SERVING_EVERY_S = 0.5
LINE_BYTES = 400_000  # longest message: the bytes already read of a connection that is handed over
STOPPING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)  # signals that end the server, and with it its children

healthy: Callable[[], bool] = lambda: True  # noqa: E731 - replaced by a process that knows better about itself


def begin() -> None:
    """From now on, die with the supervisor, and send heartbeats while `healthy` returns True. Does nothing outside
    `serve`.
    """
    descriptor = _take_descriptor(BEAT_FD)
    if descriptor is None:
        return
    _die_with(int(os.environ.pop(SUPERVISOR)))
    threading.Thread(target=_send_beats, args=(descriptor,), name="lifeline", daemon=True).start()


def inherit_socket() -> socket.socket | None:
    """Return the socket that the supervisor has bound; None if it did not start this process, or not to serve."""
    descriptor = _take_descriptor(LISTEN_FD)
    return None if descriptor is None else socket.socket(fileno=descriptor)


def inherit_line() -> socket.socket | None:
    """Return this process's end of the line between the API and its standby; None: not started by the supervisor."""
    descriptor = _take_descriptor(LINE_FD)
    return None if descriptor is None else socket.socket(fileno=descriptor)


def make_line() -> tuple[socket.socket, socket.socket]:
    """Return the standby's end and the API's end. Both outlive the two processes: no message is lost if one dies."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    for end in ends:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LINE_BYTES)
    return ends


def say(line: socket.socket, word: bytes) -> None:
    """Send SERVING or GONE to the standby, if one listens."""
    with contextlib.suppress(OSError):
        line.send(word)


def _take_descriptor(name: str) -> int | None:
    """Take over a descriptor that the environment names; child processes do not inherit it."""
    text = os.environ.pop(name, None)
    if text is None:
        return None
    os.set_inheritable(int(text), False)
    return int(text)


def _die_with(supervisor: int) -> None:
    if sys.platform == "linux":
        die_with_parent(supervisor)
    elif os.getppid() != supervisor:
        os.kill(os.getpid(), signal.SIGKILL)


def _send_beats(descriptor: int) -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # they are for the main thread, which may sleep
    poll = select.poll()
    poll.register(descriptor, 0)  # poll reports a closed end in any case
    while not poll.poll(BEAT_S * 1000):
        if healthy():
            try:
                os.write(descriptor, b".")
            except OSError:
                break
    os.kill(os.getpid(), signal.SIGKILL)
