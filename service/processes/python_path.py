"""Where a child process of ours finds these modules, started by hand or installed."""

from __future__ import annotations

import os
from pathlib import Path

_ROOT = Path(__file__).parents[2]


def python_path() -> str:
    """Return PYTHONPATH for a child: this tree, and what was asked for already."""
    return os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
