"""Real servers in tests: started, watched until something is true, and never left behind."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from service.server.database.pairing import PairingBook
from service.server.database.schema import open_database
from service.server.database.tokens import TokenBook
from service.server.pairing_code import ALPHABET, code_of, new_offer
from service.settings import ServerSettings
from tests.waiting import PATIENCE_S, until

HERE = Path(__file__).parent
CODE = rf"(?:[{ALPHABET}]{{4}}-){{2}}[{ALPHABET}]{{4}}"
STAND_INS = ("stops=", "worker=stand_in_worker", "API=stand_in_api", "agents=stand_in_agents")


def is_alive(pid: int) -> bool:
    """Runs, or is stopped; a dead process that nobody has waited for does not count."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def parent_of(pid: int) -> int:
    with contextlib.suppress(OSError, IndexError):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return -1


def descendants(pid: int) -> list[int]:
    """All processes below one, by what /proc says now."""
    parents = {int(path.name): parent_of(int(path.name)) for path in Path("/proc").glob("[0-9]*")}
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


class Serving:
    """A running `serve`, by its process; `lines` is what it said on stdout and stderr so far."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        self.out: list[str] = []
        self.err: list[str] = []
        self._readers = [
            threading.Thread(target=self._read, args=(stream, lines), daemon=True)
            for stream, lines in ((self.process.stdout, self.out), (self.process.stderr, self.err))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def url(self) -> str:
        return re.findall(r"http://\S+", self.out[0])[0]

    def until_ready(self) -> None:
        until(lambda: self.out or self.process.poll() is not None, what="the ready line")
        assert self.out and "ready in" in self.out[0], self.err

    def child(self, module: str) -> int:
        """Process id of the child that runs a module; 0 where none does."""
        for pid in descendants(self.pid):
            with contextlib.suppress(OSError):
                if parent_of(pid) == self.pid and Path(f"/proc/{pid}/cmdline").read_text().rstrip("\0").endswith(
                    module
                ):
                    return pid
        return 0

    def kill(self, pid: int, number: int = signal.SIGKILL) -> None:
        os.kill(pid, number)

    def ended(self, within_s: float = PATIENCE_S) -> int:
        """Its exit code; everything it said is there."""
        code = self.process.wait(within_s)
        for reader in self._readers:
            reader.join(PATIENCE_S)
        return code

    def _read(self, stream: Iterator[str], lines: list[str]) -> None:
        for line in stream:
            lines.append(line.rstrip("\n"))


def offer_code(data: Path) -> str:
    """A code for pairing a page, as `causticmill token pair` makes it: a server without a terminal prints none."""
    database, offer = open_database(ServerSettings(data=data), migrate=True), new_offer()
    PairingBook(database, TokenBook(database)).offer(offer)
    database.dispose()
    return code_of(offer)


@contextlib.contextmanager
def served(*arguments: str, data: Path, **environment: str) -> Iterator[Serving]:
    """`causticmill serve` with the arguments."""
    command = [sys.executable, "-m", "service.cli.main", "serve", "--data", str(data), "--port", "0", *arguments]
    with running(command, data, environment) as serving:
        yield serving


@contextlib.contextmanager
def supervised(data: Path, *arguments: str, **environment: str) -> Iterator[Serving]:
    """The supervisor with stand-ins as its children."""
    command = [sys.executable, "-m", "service.server.supervisor.supervisor", *STAND_INS, *arguments]
    settings = ServerSettings(data=data, port=0, start_agents=False).environment()
    with running(command, data, settings | {"PYTHONPATH": str(HERE)} | environment) as serving:
        yield serving


@contextlib.contextmanager
def running(command: list[str], data: Path, environment: dict[str, str]) -> Iterator[Serving]:
    """Any command with these settings; it and all below it are gone at the end."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("CAUSTICMILL_")}
    given = {"CAUSTICMILL_DATA": str(data), "CAUSTICMILL_PREPARE": "false"} | environment
    serving = Serving(command, kept | given)
    try:
        yield serving
    finally:
        below = descendants(serving.pid)
        for pid in (serving.pid, *below):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        serving.ended()
        until(lambda: not any(map(is_alive, below)), what="the end of all processes")
