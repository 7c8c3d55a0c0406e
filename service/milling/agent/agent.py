"""The parts of one agent, as its routes see them: the mill from the event loop, and which client key parked which run.

Between the event loop and the mill's own thread there is no queue and no pool that could be full: a call waits as a
future, and a stop is counted and written to the port before its coroutine waits for anything. Only slow work that is
not the mill's runs in other threads.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from machines.clock import Timeout
from machines.mill.mill import Mill
from machines.mill.orders import CARRY_OUT_S, GRANT_S, STOP_S, Caller, OrderGate, Stop
from machines.mill.thread import MillThread, no_answer
from machines.mill.view import MillSnapshot
from machines.preflight.preflight import Preflight
from machines.profile import MachineProfile
from service.http.event_hub import Hub, Reader
from service.milling.agent.programs import ProgramStore
from service.milling.agent.reporting import AuditLog
from service.milling.agent.settings import AgentSettings
from service.milling.connect import Connector, demand_blocks
from service.milling.preflight import run_preflight, write_dry_pass
from service.processes.files import write_whole

T = TypeVar("T")
_CALL_S = 60.0
_SHOWN_S = 0.1  # wait for the state after a stop; if it takes longer, the events report it
_ORDER_S = GRANT_S + 1.0
START_S = CARRY_OUT_S + 30.0  # after the grant's time, only the journal can still delay a start


class MillAccess:
    """The mill as coroutines see it."""

    def __init__(self, thread: MillThread) -> None:
        self._thread = thread
        self._workers = ThreadPoolExecutor(4, thread_name_prefix="work")
        self._silence = Timeout(_CALL_S, most_s=_CALL_S)  # of the mill's thread; checked only on request
        self._turns = 0

    @property
    def snapshot(self) -> MillSnapshot:
        return self._thread.snapshot

    @property
    def orders(self) -> OrderGate:
        return self._thread.orders

    def status(self) -> dict[str, Any]:
        return self._thread.snapshot.as_dict()

    def is_alive(self) -> bool:
        """Return whether the mill's thread runs. Only a second failed check returns False."""
        if self._thread.turns != self._turns:
            self._turns = self._thread.turns
            self._silence.restart()
        return not self._silence.is_over

    async def call(self, function: Callable[[Mill], T]) -> T:
        """Run something in the mill's thread that moves nothing."""
        return await _await_answer(self._thread.submit(function), _CALL_S)

    async def order(
        self,
        doing: str,
        act: Callable[[Mill], T],
        caller: Caller,
        *,
        needs_lease: bool = False,
        within_s: float = _ORDER_S,
    ) -> T:
        """Carry out an order under its grant; the mill may refuse it."""
        return await _await_answer(
            self._thread.submit(lambda mill: mill.carry_out(doing, act, caller, needs_lease=needs_lease)), within_s
        )

    async def halt(self, stop: Stop, caller: Caller) -> None:
        """Stop the mill. Once the byte is sent this returns, because the thread's own answer may have to wait for a
        disk.

        A link without such a byte can only be stopped by that thread: MachineError if it does not answer within STOP_S.
        """
        written, future = self._thread.halt(stop, caller)
        waiting = asyncio.wrap_future(future)
        await asyncio.wait({waiting}, timeout=_SHOWN_S if written else STOP_S)
        if not written and not waiting.done():
            raise no_answer(STOP_S, taken_back=False)
        if waiting.done():
            waiting.result()

    async def work(self, function: Callable[[], T]) -> T:
        """Run slow work that is not the mill's, such as a pre-flight, in another thread."""
        return await asyncio.get_running_loop().run_in_executor(self._workers, function)

    def close(self) -> None:
        self._workers.shutdown(wait=False, cancel_futures=True)


async def _await_answer(future: Future[T], within_s: float) -> T:
    """Wait for the mill's thread. Take the call back if it has not begun in time."""
    waiting = asyncio.wrap_future(future)
    done, _ = await asyncio.wait({waiting}, timeout=within_s)
    if done:
        return waiting.result()
    waiting.add_done_callback(lambda late: late.cancelled() or late.exception())  # nobody awaits the result any more
    raise no_answer(within_s, taken_back=future.cancel())


_MOST = 1000


class ClientKeys:
    """Remembers which client key parked which run: a client that asks again after a lost answer gets its run, not a
    second one.

    It is one small file in the data folder, replaced as a whole, so that it survives a restart of the agent.
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

    def run_preflight(self, program: Path, *, dry_pass: bool) -> Preflight:
        """Read a whole program and check it against this mill's own settings. Slow: not for the event loop's thread."""
        settings = self.connector.settings
        cache = self.settings.folder / "preflight"
        facts = run_preflight(program, self.profile, settings=settings, dry_pass=dry_pass, cache=cache)
        demand_blocks(facts, program.stem[:12])
        return facts

    def make_dry_pass(self, program: Path, lift_mm: float) -> Path:
        """Make the program of a dry pass, and keep it as its own program. Slow, too."""
        return self.store.add(
            lambda target: write_dry_pass(program, self.profile, lift_mm, target), about_bytes=program.stat().st_size
        )
