"""Our own sources: where a child process finds them, as trees of Python, read one at a time, and the state of some
files.
"""

from __future__ import annotations

import ast
import hashlib
import os
import threading
from collections.abc import Iterable
from pathlib import Path

_parsing = threading.Lock()  # CPython before 3.12 may fail where two threads parse at once (its issue 106905)
_ROOT = Path(__file__).parents[2]
PACKAGES = ("phrases", "optics", "cam", "machines", "service")
"""All of ours."""


def parse(path: Path) -> ast.Module:
    with _parsing:
        return ast.parse(path.read_bytes())


def hash_files(paths: Iterable[Path]) -> str:
    """Return hash of what these files are called and hold, in this order."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def python_path() -> str:
    """Return PYTHONPATH for a child: this tree, and what was asked for already."""
    return os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
