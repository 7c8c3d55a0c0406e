"""The parts of one agent, as its routes see them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from machines.preflight.preflight import Preflight
from machines.profile import MachineProfile
from service.http.event_hub import Hub, Reader
from service.milling.agent.audit import AuditLog
from service.milling.agent.idempotency import ClientKeys
from service.milling.agent.mill_access import MillAccess
from service.milling.agent.programs import ProgramStore
from service.milling.agent.settings import AgentSettings
from service.milling.connect import Connector, demand_blocks
from service.milling.preflight import run_preflight


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
