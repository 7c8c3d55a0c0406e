"""The links to the mills' agents: which mills there are, and where their agents are. No database."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import httpx

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.server.fleet.agent_client import AgentLink
from service.server.fleet.registry import KnownMachine, read_machines
from service.settings import ServerSettings


def no_machine(name: str, known: Iterable[str]) -> Problem:
    words = ", ".join(known) or "none; a profile of yours with [link] port makes one"
    return Problem(404, Phrase("no machine '{name}'; known: {known}", name=name, known=words), field="machine")


class AgentLinks:
    """For one event loop."""

    def __init__(self, settings: ServerSettings) -> None:
        self.settings = settings
        self.links: dict[str, AgentLink] = {}
        self.stopped_s: dict[str, float] = {}  # when a stop of a machine came by last, by `suspend_aware_clock_s`
        self._http: httpx.AsyncClient | None = None
        self._looking = ThreadPoolExecutor(1, thread_name_prefix="profiles")

    async def list_machines(self) -> tuple[dict[str, KnownMachine], list[str]]:
        """Return the machines by name, and what is wrong with the list of them."""
        return await asyncio.get_running_loop().run_in_executor(self._looking, read_machines, self.settings)

    async def find_machine(self, name: str) -> KnownMachine:
        """Return the machine; Problem 404 where there is none of this name."""
        known, _ = await self.list_machines()
        if name not in known:
            raise no_machine(name, known)
        return known[name]

    def get_link(self, machine: KnownMachine) -> AgentLink:
        """Return the link to its agent; a new one where the machine has changed."""
        found = self.links.get(machine.name)
        if found is None or found.machine != machine:
            found = self.links[machine.name] = AgentLink(machine, self.get_http_client)
        return found

    def known_link(self, machine: str) -> AgentLink | None:
        """Return the link used before, without a look at any file."""
        return self.links.get(machine)

    async def renew_link(self, machine: str) -> AgentLink:
        """Return the link by the profiles as they are now, read by a thread that nothing else uses. Problem 404."""
        known, _ = await asyncio.get_running_loop().run_in_executor(self._looking, read_machines, self.settings)
        if machine not in known:
            raise no_machine(machine, known)
        return self.get_link(known[machine])

    async def meet_agents(self) -> None:
        """Find the address of every mill's agent before the first order or stop. Skip an agent that is away."""
        known, _ = await self.list_machines()
        met = (self.get_link(machine).find_address() for machine in known.values())
        await asyncio.gather(*met, return_exceptions=True)

    async def close(self) -> None:
        if self._http is not None:
            await self._http.aclose()
            self._http = None
        self._looking.shutdown(wait=False, cancel_futures=True)

    def get_http_client(self) -> httpx.AsyncClient:
        """Return one client for all agents and cameras, made in the loop that uses it. No proxies: all are near."""
        if self._http is None:
            limits = httpx.Limits(max_connections=None, max_keepalive_connections=20, keepalive_expiry=30)
            self._http = httpx.AsyncClient(trust_env=False, limits=limits, headers={"User-Agent": "causticmill"})
        return self._http
