"""A real agent in this process: what `causticmill mill` runs, in a thread, on a loopback port of its own."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

from service.milling.agent.main import run_agent
from service.milling.agent.settings import make_agent_settings
from service.milling.connect import machine_and_port
from tests.service.milling.agent.client import AgentClient, await_agent
from tests.waiting import PATIENCE_S


class _Stop(asyncio.Event):
    """Told once it stays told: the agent gives the hold and does not wait until the mill stands."""

    def clear(self) -> None: ...


class AgentThread:
    """As the process it owns the folder and has its card there while it lives."""

    def __init__(self, machine: str, folder: Path, port_url: str | None = None) -> None:
        self.folder = folder
        self._told = threading.Event()
        profile, url = machine_and_port(machine, port_url)
        settings = make_agent_settings(
            machine=machine,
            port_url=url,
            own_port=port_url,
            host="127.0.0.1",
            bind_port=0,
            data=folder,
            token_file=None,
        )
        self._thread = threading.Thread(
            target=lambda: run_agent(settings, profile, catch_stop=self._catch_stop), daemon=True
        )
        self._thread.start()

    def is_alive(self) -> bool:
        return self._thread.is_alive()

    def stop(self) -> None:
        self._told.set()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    @contextlib.contextmanager
    def _catch_stop(self) -> Iterator[asyncio.Event]:
        stop, loop = _Stop(), asyncio.get_running_loop()

        def listen() -> None:
            self._told.wait()
            with contextlib.suppress(RuntimeError):  # it has ended by itself
                loop.call_soon_threadsafe(stop.set)

        threading.Thread(target=listen, daemon=True).start()
        yield stop


@contextlib.contextmanager
def running_agent(folder: Path, port_url: str) -> Iterator[AgentClient]:
    """One of a GRBL mill, told to stop at the end."""
    thread = AgentThread("grbl", folder, port_url)
    try:
        agent = AgentClient(folder, await_agent(folder).url)
        with agent.http:
            yield agent
    finally:
        thread.stop()
