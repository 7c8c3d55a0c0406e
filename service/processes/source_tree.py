"""Python sources as trees, read one at a time."""

from __future__ import annotations

import ast
import threading
from pathlib import Path

_parsing = threading.Lock()  # CPython before 3.12 may fail where two threads parse at once (its issue 106905)


def parse(path: Path) -> ast.Module:
    with _parsing:
        return ast.parse(path.read_bytes())
