"""`python -m service.server.supervisor.supervisor`: the process of `causticmill serve`, configured by its environment.

It locks the data folder, binds the address, and starts worker, API and the API's standby, which serves stops, as its
children; it starts each again when it dies or freezes, and ends all of them when it is asked to. It holds nothing else,
and imports only the standard library: it lives as long as the server does. Children die with it, even if it is killed
(`processes.lifeline`); agents of mills do not.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import TextIO

from service.errors import EXIT_FAILURE, EXIT_INPUT, ServiceError, printable
from service.http.hosts import bind_address, is_answering, read_complaint, url_of
from service.processes import lifeline
from service.processes.files import lock_folder
from service.server.pairing_code import code_lines, code_of, new_offer
from service.server.supervisor.child import SupervisedChild

_PREFIX = "CAUSTICMILL_"
_MODULES = {
    "stops": "service.server.standby.main",
    "worker": "service.server.worker.main",
    "API": "service.server.api.main",
    "agents": "service.server.fleet.agent_launcher",
}
_SIMULATED = {
    "simulated mill": "service.server.supervisor.simulated_mill",
    "simulated agent": "service.server.supervisor.simulated_agent",
}
_GRACE_S = 20.0
_FIRST_FAILURES = 5
_PROBE_S = 0.05
_LONG_S = 10.0  # a healthy server is ready sooner
_LONG_PROBE_S = 2.0
_ANSWER_S = 1.0
_TICK_S = 60.0


class Supervisor:
    """Worker and API of one data folder, and perhaps a simulated mill, from start to stop.

    offer : id and code with which a page may be paired; "" where no terminal would show it
    """

    def __init__(self, listener: socket.socket, modules: Mapping[str, str], *, offer: str, began: float) -> None:
        self._listener = listener
        self._offer = offer
        self._began = began
        self._ready = False
        self._announced = False
        self._signals = 0
        self._heeded = 0
        self._code: int | None = None
        self._kill_at = 0.0
        self._starter: subprocess.Popen[bytes] | None = None
        self._starts = modules.get("agents")
        self._probe = "/readyz" if "worker" in modules else "/livez"
        names = [name for name in ("stops", "worker", "API", *_SIMULATED) if name in modules]
        self._line = lifeline.make_line()
        self._children = [_watch(name, modules[name], listener, self._line, offer) for name in names]

    def run(self) -> int:
        """Run until a signal stops it, or until a child refuses its configuration; return the exit code."""
        with _wakeups(self._obey_signal) as wake, selectors.DefaultSelector() as selector:
            selector.register(wake, selectors.EVENT_READ)
            for child in self._children:
                child.start()
            while self._code is None or any(child.running for child in self._children):
                selector.select(self._select_timeout_s())
                with contextlib.suppress(BlockingIOError):
                    wake.recv(4096)
                self._handle_signal()
                self._look()
            return self._code

    def _obey_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._signals += 1

    def _handle_signal(self) -> None:
        """Ask the children to end well at the first signal, end them at the second."""
        heard = self._signals  # another may come while this one is handled
        if heard > self._heeded:
            if self._code is None:
                self._stop(0)
            elif heard > 1:
                self._kill_at = 0.0
            self._heeded = heard

    def _look(self) -> None:
        for child in self._children:
            child.look(wanted=self._code is None)
        if self._starter is not None and self._starter.poll() is not None:
            self._starter = None
        if self._code is None:
            self._judge()
        elif time.monotonic() >= self._kill_at:
            for child in self._children:
                child.signal(signal.SIGKILL)

    def _judge(self) -> None:
        """Stop if a child cannot go on; announce once that the server is ready."""
        if any(child.refused for child in self._children):
            self._stop(EXIT_INPUT)  # the child has given the reason itself
            return
        if self._ready:
            return
        for child in self._children:
            if child.failed or child.failures >= _FIRST_FAILURES:
                if not child.failed:
                    _say(f"error: the {child.name} ended {child.failures} times before it was ready; see above")
                self._stop(EXIT_FAILURE)
                return
        if is_answering(self._listener, self._probe, timeout_s=_ANSWER_S):
            self._ready = True
            for child in self._children:
                child.trusted = True
            self._announce(f"ready in {time.time() - self._began:.1f} s")
        elif not self._announced and time.time() - self._began > _LONG_S:
            words = read_complaint(self._listener, self._probe, timeout_s=_ANSWER_S)
            if words is not None:
                self._announce(f"not ready: {words}")

    def _announce(self, words: str) -> None:
        """Announce the address and the state. A mill needs its agent even if no jobs can be accepted."""
        where, folder = url_of(self._listener), _read_setting("DATA")
        with contextlib.suppress(OSError):
            print(f"causticmill on {where} (data: {folder}), {words}", flush=True)
            if self._ready:
                self._show_code(where)
        if not self._announced and self._starts is not None and _read_setting("START_AGENTS") == "true":
            command = [sys.executable, "-P", "-m", self._starts]
            self._starter = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sys.stderr)
        self._announced = True

    def _show_code(self, where: str) -> None:
        """Show the code only on a terminal: it gives access to a mill, and files and pipes are stored and passed on."""
        if (terminal := _terminal()) is not None and self._offer:
            terminal.write(code_lines(terminal, where, code_of(self._offer)))
            terminal.flush()
        else:
            words = f"causticmill token pair --data {_read_setting('DATA')}"
            print(f"open {where} in a browser; on a terminal, this prints a code for it: {words}", flush=True)

    def _stop(self, code: int) -> None:
        self._code = code
        self._kill_at = time.monotonic() + _GRACE_S
        for child in self._children:
            child.signal(signal.SIGTERM)
            child.signal(signal.SIGCONT)

    def _select_timeout_s(self) -> float:
        """Return the time until something must be checked if no signal comes."""
        if self._code is None and not self._ready:
            return _LONG_PROBE_S if self._announced else _PROBE_S
        due = [child.due_at for child in self._children if child.due_at is not None]
        if self._code is not None:
            due.append(self._kill_at if self._kill_at else time.monotonic() + _PROBE_S)
        return max(0.01, min([_TICK_S, *(at - time.monotonic() for at in due)]))


def main() -> int:
    """Run as `causticmill serve`. An argument name=module sets the module of worker, API or agents; name=: none."""
    began = float(os.environ.pop(f"{_PREFIX}BEGAN", time.time()))
    modules = _MODULES | (_SIMULATED if _read_setting("SIMULATED_MILL") == "true" else {})
    modules |= {name: module for name, _, module in (word.partition("=") for word in sys.argv[1:])}
    try:
        with (
            lock_folder(Path(_read_setting("DATA"))),
            contextlib.closing(bind_address(_read_setting("HOST"), int(_read_setting("PORT")))) as listener,
        ):
            wanted = {name: module for name, module in modules.items() if module}
            return Supervisor(listener, wanted, offer=new_offer() if _terminal() else "", began=began).run()
    except ServiceError as error:
        _say(f"error: {error}")
        return error.exit_code


def _terminal() -> TextIO | None:
    return next((stream for stream in (sys.stdout, sys.stderr) if stream is not None and stream.isatty()), None)


def _read_setting(name: str) -> str:
    """Read a setting; the command has checked them all and put them into the environment, defaults too."""
    return os.environ[f"{_PREFIX}{name}"]


def _watch(
    name: str, module: str, listener: socket.socket, line: tuple[socket.socket, socket.socket], offer: str
) -> SupervisedChild:
    environment = os.environ | {f"{_PREFIX}PORT": str(listener.getsockname()[1])}
    standby, api = line
    passed: tuple[int, ...] = ()

    def note_end() -> None:
        if name == "API":
            lifeline.say(api, lifeline.GONE)

    if name in ("API", "stops"):
        end = api if name == "API" else standby
        passed = (listener.fileno(), end.fileno())
        environment |= {lifeline.LISTEN_FD: str(passed[0]), lifeline.LINE_FD: str(passed[1])}
    if name == "API":
        environment |= {lifeline.PAIRING_OFFER: offer}
    lease_s = float(_read_setting("LEASE_S"))
    return SupervisedChild(name, module, environment, lease_s=lease_s, passed=passed, say=_say, on_end=note_end)


@contextlib.contextmanager
def _wakeups(stop: Callable[[int, FrameType | None], None]) -> Iterator[socket.socket]:
    """Yield a socket that becomes readable with every signal: children's ends, and those that stop us."""
    ours, its = socket.socketpair()
    with ours, its:
        ours.setblocking(False)
        its.setblocking(False)
        signal.set_wakeup_fd(its.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        for kind in lifeline.STOPPING:
            if signal.getsignal(kind) is not signal.SIG_IGN:  # a signal ignored by nohup stays ignored
                signal.signal(kind, stop)
        yield ours
        signal.set_wakeup_fd(-1)


def _say(line: str) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.write(printable(line) + "\n")  # in one piece: the children write there, too
        sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
