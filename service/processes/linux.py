"""Linux functions that the standard library lacks: signals when a parent dies, adoption of orphans, members of a
process group. Also priorities on a busy computer: first the agents of mills, then servers, then computing processes.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from pathlib import Path

_SET_PDEATHSIG = 1
_SET_NAME = 15
_SET_CHILD_SUBREAPER = 36
_PUNCH_HOLE = 3  # FALLOC_FL_KEEP_SIZE | FALLOC_FL_PUNCH_HOLE
_LIBC = ctypes.CDLL(None, use_errno=True)  # looked up here, so that nothing needs loading between a fork and its use

FIRST, BEHIND = -5, 10  # nice values; servers have 0


def die_with_parent(parent: int, number: int = signal.SIGKILL) -> None:
    """Request this signal for when the *thread* that started this process ends; end at once if `parent` has already
    ended.
    """
    if _LIBC.prctl(_SET_PDEATHSIG, number, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def adopt_orphans() -> None:
    """Make this process the parent of descendants whose parent dies, from now on."""
    if _LIBC.prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")


def name_process(name: str) -> None:
    """Set the name that `ps` and `top` show; at most 15 bytes."""
    _LIBC.prctl(_SET_NAME, name.encode(), 0, 0, 0)


def give_back_blocks(path: Path, start: int, length: int) -> None:
    """Turn these bytes of the file into a hole that takes no space; do nothing if the file system cannot."""
    with path.open("r+b") as file:
        _LIBC.fallocate(file.fileno(), _PUNCH_HOLE, ctypes.c_long(start), ctypes.c_long(length))


def own_children() -> list[int]:
    """Return the children of this process, including dead ones that have not been waited for."""
    found: list[int] = []
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # a thread that has just ended; or a kernel without this list
            found += map(int, (task / "children").read_bytes().split())
    return found


def signal_group(leader: int, number: int) -> bool:
    """Send a signal to every process of a group. False: none is left, not even a dead one not yet waited for."""
    try:
        os.killpg(leader, number)
    except ProcessLookupError:
        return False
    return True


def signal_stage(leader: int, number: int) -> None:
    """Send a signal to the group of `leader`, or to it alone as long as it has made no group yet."""
    with contextlib.suppress(ProcessLookupError):
        if not signal_group(leader, number):
            os.kill(leader, number)


def list_living_members(group: int) -> list[int]:
    """List the running processes of a group; dead ones that have not been waited for do not count."""
    found = ((pid, _state_and_group(pid)) for pid in _all_processes())
    return [pid for pid, (state, its_group) in found if its_group == group and state not in "ZX"]


def thread_count() -> int:
    """Return the number of threads of this process."""
    return len(list(Path("/proc/self/task").iterdir()))


def address_space_bytes() -> int:
    """Return the address space of this process."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _all_processes() -> list[int]:
    return [int(name) for name in os.listdir("/proc") if name.isdigit()]  # noqa: PTH208 - plain names, quickly


def _state_and_group(pid: int) -> tuple[str, int]:
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    except OSError:
        return "X", -1
    return after_name[0], int(after_name[2])


def go_first() -> None:
    """Raise the priority of this thread and all that it starts from now on, if the system permits it: for root, with
    CAP_SYS_NICE, and as far as RLIMIT_NICE allows. Otherwise nothing changes.
    """
    _set_nice(min(FIRST, _read_nice()))


def give_way() -> None:
    """Lower the priority of this thread and of all processes that it starts from now on, unless it is already lower."""
    _set_nice(max(BEHIND, _read_nice()))


def _read_nice() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0)


def _set_nice(nice: int) -> None:
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
