"""Starts the agents of this computer's mills, reports the result of each, and ends. It is a separate process, so that
the supervisor need not import its modules. From then on the agents are independent: in their own sessions, children of
init.

The lock in a mill's folder shows whether it has an agent; the system releases it with the process that holds it. Two
servers that start one agent at once do no harm: the second agent finds folder and port taken and ends.
"""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

from service.errors import ServiceError, printable, sentence_of_os_error
from service.processes.files import make_private
from service.server.fleet.registry import KnownMachine, local_folder, read_machines
from service.settings import PREFIX, ServerSettings

LOG_FILE = "agent.log"
_KEPT = {f"{PREFIX}CONFIG_DIR"}  # the folder of profiles; an agent does not need the server's database or store
_DETACHED = '"$@" >>"$0" 2>&1 </dev/null & echo $!'
_LONGEST_LOG_BYTES = 5_000_000


def start_agents(settings: ServerSettings) -> list[tuple[str, str]]:
    """Start the agents that do not run yet; yield each machine and the result in words. Does not wait for them."""
    machines, _ = read_machines(settings)
    own = [machine for machine in machines.values() if not machine.remote and not machine.simulated]
    return [(machine.name, _start(settings, machine)) for machine in own]


def _start(settings: ServerSettings, machine: KnownMachine) -> str:
    if machine.problem:
        return machine.problem
    if (owner := next((folder for folder in machine.folders if is_owned(folder)), None)) is not None:
        return f"has its agent already, in {owner}"
    folder = local_folder(settings, machine.name)
    try:
        make_private(folder)
        pid = _launch(machine.name, folder)
    except (OSError, subprocess.SubprocessError) as error:
        words = sentence_of_os_error(error, doing="cannot start") if isinstance(error, OSError) else str(error)
        return f"its agent could not be started: {words}"
    return f"agent started, process {pid}; log: {folder / LOG_FILE}"


def is_owned(folder: Path) -> bool:
    """Return whether a living process, agent or stream, holds the lock of this mill's folder.

    The lock is tried only if its owner seems to be alive, so that an agent that is just starting never finds it taken
    by us.
    """
    try:
        descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        owner = os.pread(descriptor, 32, 0).strip()
        if not owner.isdigit() or not _is_alive(int(owner)):
            return False
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError as error:
        return isinstance(error, PermissionError)  # another account's
    return True


def _launch(machine: str, folder: Path) -> int:
    """Start the agent in its own session, from a starter that ends at once, so that signals to us or our group do not
    reach it.
    """
    log = folder / LOG_FILE
    if log.exists() and log.stat().st_size > _LONGEST_LOG_BYTES:
        log.replace(log.with_suffix(".log.1"))
    command = [sys.executable, "-m", "service.cli.main", "mill", "--machine", machine, "--data", str(folder)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(PREFIX) or key in _KEPT}
    shell = subprocess.run(
        ["/bin/sh", "-c", _DETACHED, str(log), *command, "--bind-port", "0"],
        env=environment,
        start_new_session=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        timeout=10,
        check=True,
    )
    return int(shell.stdout)


def main() -> int:
    """Start the agents; one line for each mill goes to stderr."""
    try:
        said = start_agents(ServerSettings.load())
    except ServiceError as error:
        print(f"agents: {error}", file=sys.stderr)
        return error.exit_code
    for machine, words in said:
        print(printable(f"{machine}: {words}"), file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
