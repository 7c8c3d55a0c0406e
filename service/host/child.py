"""`python -m service.host.child MODULE`: run a module as the supervisor's child, tied to its life."""

from __future__ import annotations

import runpy
import sys

from service.host import lifeline


def main() -> None:
    """The module sees itself as the main program, with the arguments after its name."""
    lifeline.begin()
    module = sys.argv[1]
    sys.argv = sys.argv[1:]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
