"""One child of the supervisor: starts it, reads its heartbeats, restarts it with growing pauses, stops it.

`python -m service.server.supervisor.child MODULE` is that child: it runs the `main` of a module, and ends when the
supervisor ends.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping

from machines.clock import Timeout
from service.processes import lifeline

Say = Callable[[str], None]
_FIRST_WAIT_S = 0.1
_LONGEST_WAIT_S = 10.0
_LIVED_WELL_S = 5.0
FAILED, REFUSED = 1, 2


class SupervisedChild:
    """Keeps `module` running while it is wanted; `beats` is the pipe of its heartbeats (None while it does not run).

    trusted : the server was ready with it
    lease_s : it is killed after so long without a heartbeat; `passed` are descriptors that it inherits
    on_end  : called each time it has ended
    """

    def __init__(
        self,
        name: str,
        module: str,
        environment: Mapping[str, str],
        *,
        lease_s: float,
        passed: tuple[int, ...],
        say: Say,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self.name = name
        self.beats: int | None = None
        self.code: int | None = None
        self.failures = 0
        self.trusted = False
        self._proven = False
        self._command = [sys.executable, "-P", "-m", "service.server.supervisor.child", module]
        self._environment = dict(environment)
        self._lease_s = lease_s
        self._passed = passed
        self._say = say
        self._on_end = on_end
        self._process: subprocess.Popen[bytes] | None = None
        self._started_at = self._listened_at = 0.0
        self._silence = Timeout(lease_s, most_s=lease_s)  # looked at four times a lease
        self._again_at: float | None = None
        self._wait_s = 0.0

    @property
    def running(self) -> bool:
        return self._process is not None

    @property
    def refused(self) -> bool:
        """Act on a child that has refused its configuration. A configuration that it accepted before cannot be at
        fault: then the child is restarted.
        """
        return self.code == REFUSED and not self.running and not self._proven

    @property
    def failed(self) -> bool:
        """The child ended by itself, with a reason, before the server was ready: a restart would fail again."""
        return self.code == FAILED and not self.trusted

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process is not None else None

    @property
    def due_at(self) -> float | None:
        """When `look` must be called next if nothing happens before."""
        return self._again_at if self._process is None else self._listened_at + self._lease_s / 4

    def start(self) -> None:
        ours, its = os.pipe()
        os.set_blocking(ours, False)
        environment = self._environment | {lifeline.BEAT_FD: str(its), lifeline.SUPERVISOR: str(os.getpid())}
        try:
            self._process = subprocess.Popen(
                self._command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(its, *self._passed),
                start_new_session=True,
            )
        except BaseException:
            os.close(ours)
            raise
        finally:
            os.close(its)
        self.beats, self._again_at = ours, None
        self._started_at = self._listened_at = time.monotonic()
        self._silence.restart()

    def listen(self) -> None:
        """Read the heartbeats that have arrived."""
        self._listened_at = time.monotonic()
        with contextlib.suppress(BlockingIOError):
            while self.beats is not None and os.read(self.beats, 4096):
                self._silence.restart()

    def look(self, *, wanted: bool) -> None:
        """Notice the child's end, kill it if it is frozen, restart it when it is due."""
        now = time.monotonic()
        if self._process is not None:
            self.listen()
            if self._process.poll() is None and self._silence.is_over:
                self._say(f"the {self.name} was not heard of for {self._lease_s:g} s and is killed")
                self.signal(signal.SIGKILL)
                self._silence.restart()
            if self._process.poll() is not None:
                self._record_end(now, wanted=wanted)
        elif wanted and self._again_at is not None and now >= self._again_at:
            self.start()

    def signal(self, number: int) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(number)

    def _record_end(self, now: float, *, wanted: bool) -> None:
        assert self._process is not None and self.beats is not None
        lived_well = now - self._started_at >= _LIVED_WELL_S
        self._proven = self._proven or (self.trusted and lived_well)
        self.code, self._process = self._process.returncode, None
        os.close(self.beats)
        self.beats = None
        self._on_end()
        if not wanted or self.refused or self.failed:
            return
        self.failures += 1
        self._wait_s = _FIRST_WAIT_S if lived_well else min(max(2 * self._wait_s, _FIRST_WAIT_S), _LONGEST_WAIT_S)
        self._again_at = now + self._wait_s
        self._say(f"the {self.name} {_describe_end(self.code)}; it is started again")


def _describe_end(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


def main() -> int | None:
    """Run a module's `main`; it sees its own name and the arguments after it."""
    lifeline.begin()
    sys.argv = sys.argv[1:]
    gc.disable()  # everything that importing creates stays
    module = importlib.import_module(sys.argv[0])
    gc.freeze()
    gc.enable()
    return module.main()


if __name__ == "__main__":
    sys.exit(main())
