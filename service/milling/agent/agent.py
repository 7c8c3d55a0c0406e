"""The parts of one agent, as its routes see them; and which client key parked which run."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path

from machines.preflight.preflight import Preflight
from machines.profile import MachineProfile
from service.http.event_hub import Hub, Reader
from service.milling.agent.mill_access import MillAccess
from service.milling.agent.programs import ProgramStore
from service.milling.agent.reporting import AuditLog
from service.milling.agent.settings import AgentSettings
from service.milling.connect import Connector, demand_blocks
from service.milling.preflight import run_preflight
from service.processes.files import write_whole

_MOST = 1000


class ClientKeys:
    """Which client key parked which run: a client that asks again after a lost answer gets its run, not a second one.

    One small file in the data folder, replaced whole, so that it holds across a new start of the agent.
    """

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Agent:
    settings: AgentSettings
    profile: MachineProfile
    access: MillAccess
    store: ProgramStore
    hub: Hub[Reader]
    connector: Connector
    keys: ClientKeys
    audit: AuditLog

    def run_preflight(self, program: Path) -> Preflight:
        """Read a program whole, held against this mill's own settings. Slow: not for the event loop's thread."""
        settings = self.connector.settings
        facts = run_preflight(program, self.profile, settings=settings, cache=self.settings.folder / "preflight")
        demand_blocks(facts, program.stem[:12])
        return facts
