"""`causticmill` as a person runs it: another process."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from typing import Any

COMMAND = [sys.executable, "-m", "service.cli.main"]


def settings(values: Mapping[str, object]) -> list[str]:
    """`--set KEY=VALUE` for each."""
    return [part for key, value in values.items() for part in ("--set", f"{key}={value}")]


def ran(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Ended, with what it printed; options: of `subprocess.run`."""
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, check=False, **options)
