"""What a child of `serve` inherits from its supervisor: a pipe for beats, the bound socket to serve, and the line
between API and standby.

The pipe tells both ways: without beats the supervisor takes the child for frozen, and a supervisor that is gone closes
it. Only what the standard library has is imported here.
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
SERVING, GONE = b"serving", b"gone"  # what is said on the line between API and standby
SERVING_EVERY_S = 0.5
LINE_BYTES = 400_000  # at most in one message: what was read of a connection that is handed over
STOPPING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)  # what ends the server, and with it its children

healthy: Callable[[], bool] = lambda: True  # noqa: E731 - replaced by a process that knows better about itself


def begin() -> None:
    """Die with the supervisor from now on, and beat as long as `healthy` says so. Nothing outside of `serve`."""
    descriptor = _take_descriptor(BEAT_FD)
    if descriptor is None:
        return
    _die_with(int(os.environ.pop(SUPERVISOR)))
    threading.Thread(target=_send_beats, args=(descriptor,), name="lifeline", daemon=True).start()


def inherit_socket() -> socket.socket | None:
    """Return the address the supervisor has bound; None: not started by it, or not to serve."""
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
    """Say SERVING or GONE to the standby, if there is one that listens."""
    with contextlib.suppress(OSError):
        line.send(word)


def _take_descriptor(name: str) -> int | None:
    """Take a descriptor named by the environment, from now on this process's alone."""
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
