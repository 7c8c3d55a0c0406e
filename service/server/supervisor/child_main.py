"""`python -m ....child_main MODULE`: run a module's `main` as the supervisor's child, tied to its life."""

from __future__ import annotations

import gc
import importlib
import sys

from service.processes import lifeline


def main() -> int | None:
    """Return the module sees its own name and the arguments after it."""
    lifeline.begin()
    sys.argv = sys.argv[1:]
    gc.disable()  # importing makes nothing but what stays
    module = importlib.import_module(sys.argv[0])
    gc.freeze()
    gc.enable()
    return module.main()


if __name__ == "__main__":
    sys.exit(main())
