"""Which client key parked which run: a client that asks again after a lost answer gets its run, not a second one.

One small file in the data folder, replaced whole, so that it holds across a new start of the agent.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from service.processes.whole_file import write_whole

_MOST = 1000


class ClientKeys:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._runs: dict[str, str] = {}
        with contextlib.suppress(OSError, ValueError, AttributeError):  # lost keys cost a second parked run at most
            self._runs = {str(key): str(run) for key, run in json.loads(path.read_text()).items()}

    def run_of(self, key: str) -> str | None:
        return self._runs.get(key)

    def remember(self, key: str, run_id: str) -> None:
        self._runs[key] = run_id
        while len(self._runs) > _MOST:
            del self._runs[next(iter(self._runs))]
        write_whole(self._path, json.dumps(self._runs))
