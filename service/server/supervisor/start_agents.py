"""Start the agents of this computer's mills, say what became of each, and end.

A process of its own, so that the supervisor need not hold what this needs.
"""

from __future__ import annotations

import sys

from service.errors import ServiceError, printable


def main() -> int:
    """Start the agents; one line for each mill goes to stderr."""
    from service.server.fleet.agent_launcher import start_agents
    from service.settings import ServerSettings

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
