"""`python -m service.server.supervisor.simulated_agent`: the agent of the simulated mill, as a child of `serve`.

Agents of real mills outlive the server. This one ends with the server, because its mill does too.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from machines.errors import MachineError
from machines.profile import load_profile
from service.errors import ServiceError
from service.milling.agent.main import run_agent
from service.milling.agent.settings import make_agent_settings
from service.server.fleet.registry import SIMULATED, folder_of_simulated
from service.settings import ServerSettings

_TIMEOUT_S = 20.0


def main() -> int:
    """Run until SIGTERM."""
    try:
        folder = folder_of_simulated(ServerSettings.load())
        _await(folder / "port")
        profile = load_profile(SIMULATED, (folder,))
        port = profile.link.port or ""
        run_agent(
            make_agent_settings(
                machine=SIMULATED,
                port_url=port,
                own_port=port,
                host="127.0.0.1",
                bind_port=0,
                data=folder / "agent",
                token_file=None,
            ),
            profile,
        )
    except (ServiceError, MachineError, LookupError) as error:
        print(f"error: the agent of the simulated mill: {error}", file=sys.stderr, flush=True)
        return 3  # neither of the codes that end the server, so it is started again
    return 0


def _await(port: Path) -> None:
    """Wait for the mill, which is started at the same time."""
    until = time.monotonic() + _TIMEOUT_S
    while not port.exists() and time.monotonic() < until:
        time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main())
