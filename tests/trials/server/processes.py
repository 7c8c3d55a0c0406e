"""Every process of one deployment, found in /proc by the mark in its environment, whoever its parent is by now."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

MARK = "TRIAL_MARK"

_KINDS = (
    ("service.server.supervisor.supervisor", "host"),
    ("service.processes.fork_server", "fork server"),
    ("service.server.worker.main", "worker"),
    ("service.server.api.main", "api"),
    ("service.server.standby.main", "standby"),
    ("service.server.api.intake.picture_child", "picture"),
    (" serve", "host"),
    (" worker", "worker"),
)
_ID = 36  # characters of a job's id


@dataclass(frozen=True, slots=True)
class Process:
    """kind: host, api, standby, worker, fork server, stage, picture or other.

    job: the one that a stage's process works for; frozen: stopped by SIGSTOP
    """

    pid: int
    parent: int
    kind: str
    job: str = ""
    frozen: bool = False


def processes(mark: str) -> list[Process]:
    """Those that live now; a dead one not yet waited for does not."""
    found = [process for pid in _pids() if (process := _seen(pid, mark)) is not None]
    fork_servers = {process.pid for process in found if process.kind == "fork server"}
    return [
        Process(p.pid, p.parent, "stage", _job_of(p.pid), p.frozen)
        if p.kind == "fork server" and p.parent in fork_servers
        else p
        for p in found
    ]


def of_kind(mark: str, *kinds: str) -> list[Process]:
    return [process for process in processes(mark) if process.kind in kinds]


def touching(folders: Sequence[Path]) -> list[int]:
    """Processes that work in one of the folders or have a file of it open, whatever their environment says."""
    roots = tuple(f"{folder.resolve()}/" for folder in folders)
    return [pid for pid in _pids() if any(f"{place}/".startswith(roots) for place in _places(pid))]


def kill(pids: Iterable[int], number: int = signal.SIGKILL) -> int:
    """Send a signal to each; how many were there to get it."""
    hit = 0
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
            hit += 1
    return hit


def wait_until(good: object, patience_s: float, *, every_s: float = 0.05) -> bool:
    """Poll `good()` until it is true; False when patience ends."""
    assert callable(good)
    give_up_s = time.monotonic() + patience_s
    while not good():
        if time.monotonic() > give_up_s:
            return False
        time.sleep(every_s)
    return True


def _pids() -> Iterator[int]:
    own = os.getpid()
    yield from (int(name) for name in os.listdir("/proc") if name.isdigit() and int(name) != own)  # noqa: PTH208


def _seen(pid: int, mark: str) -> Process | None:
    folder = Path(f"/proc/{pid}")
    try:
        if f"{MARK}={mark}\0".encode() not in (folder / "environ").read_bytes():
            return None
        after_name = (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()
        command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").rstrip()
    except OSError:
        return None
    if after_name[0] in "ZX":
        return None
    kind = next((kind for word, kind in _KINDS if word in command), "other")
    return Process(pid, int(after_name[1]), kind, frozen=after_name[0] in "Tt")


def _job_of(pid: int) -> str:
    """A stage writes to a log that is named by its job and try; before and after that it is nobody's."""
    with contextlib.suppress(OSError):
        log = Path(f"/proc/{pid}/fd/1").readlink().name
        return log[:_ID] if log.removesuffix(" (deleted)").endswith(".log") else ""
    return ""


def _places(pid: int) -> Iterator[str]:
    folder = Path(f"/proc/{pid}")
    with contextlib.suppress(OSError):
        yield str((folder / "cwd").readlink())
        for entry in (folder / "fd").iterdir():
            with contextlib.suppress(OSError):
                yield str(entry.readlink())
