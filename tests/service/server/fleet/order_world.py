"""Page, server, agent and mill in one process and in simulated time; between them a network, a database and people.

Theory of operation. An event loop whose clock is the simulated mill's: where it would sleep, the mill's owner is
stepped instead, so that a history of minutes takes milliseconds and is the same each time. The owner is a greenlet, in
place of its thread in an agent: where the disk hangs under it the loop goes on without it, until the hang is over.
Server and agent are the real ones (Orders, Stops, Controls, AgentLink; the agent's HTTP application, grants, Mill and
GRBL session). Modelled are the page (its rule: a grant at the press, the order only if that came within 2 s) and what
is between: every message may be late, come twice, be refused by a full server, or lose its answer. `acts` holds what
came of the orders, as a tap on the wire shows it: each time the first byte of something that can move the mill, or
changes what a motion means, is written, with whose word it was.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import selectors
import tempfile
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import sqlalchemy as sa
from greenlet import getcurrent, greenlet

from machines.driver import Driver, MillState, Reset, SetZero, Travel, Unlock
from machines.errors import MachineError
from machines.gcode.program import ProgramReader
from machines.grbl.driver import GrblDriver
from machines.grbl.states import Phase
from machines.grbl.streaming import Stream
from machines.journal.disk import RealDisk, RealFile
from machines.journal.journal import Journal
from machines.mill.mill import Mill
from machines.mill.orders import NOBODY, Caller, OrderGate, Stop
from machines.mill.run import Run
from machines.mill.thread import MillThread
from machines.preflight.preflight import Preflight
from machines.profile import load_profile
from machines.recovery.plan_model import Reentry
from machines.runs import Confirmation
from machines.simulated import GRBL_11, SimulatedMill
from machines.simulated.endpoints import MemoryPort
from service.http.event_hub import Hub
from service.milling.agent.agent import Agent, ClientKeys, MillAccess
from service.milling.agent.app import make_app
from service.milling.agent.programs import ProgramStore
from service.milling.agent.settings import AgentSettings
from service.server.database.connection import connect
from service.server.database.tables import metadata, runs
from service.server.fleet.core import FleetCore
from service.server.fleet.orders import Controls, Orders, Stops
from service.server.fleet.registry import KnownMachine
from service.settings import ServerSettings
from tests.machines.disks import InlineSyncer
from tests.service.server.fleet.order_network import MessageNetwork
from tests.service.server.fleet.order_people import CHECKS, MACHINE, People

_QUIET = frozenset({MillState.IDLE, MillState.HELD, MillState.ALARM})
_SLICE_S = 0.25
_TOKEN = "t" * 40
_STOPS_AND_QUESTIONS = b"?!\x85\x18"
_QUESTIONS = frozenset({b"$I", b"$$", b"$#", b"$G", b""})
_OVERRIDES = bytes(range(0x90, 0x9E))


@dataclass
class Act:
    """The first byte of something that can move the mill is written, or of a later leg of a way (`goes_on`)."""

    press: int
    what: str
    at_s: float
    lease: str  # digest of who has control now
    seen: str  # digest of plan or set-up as it is now
    goes_on: bool = False


@cache
def _empty_database() -> bytes:
    """With its tables, for all worlds: they take a tenth of a history to make."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "runs.db"
        database = connect(f"sqlite:///{path}")
        metadata.create_all(database)
        database.dispose()
        return path.read_bytes()


class _Tap(MemoryPort):
    """Shows all that is written to the mill."""

    def __init__(self, world: World) -> None:
        super().__init__(world.sim, baud=None)
        self._world = world

    def write(self, data: bytes) -> None:
        self._world.note_written(data)
        super().write(data)


class _Disk(RealDisk):
    """A disk that hangs when the world says so, at whatever is done with it."""

    def __init__(self, world: World) -> None:
        self._world = world

    def make_folder(self, path: Path) -> None:
        self._world.use_disk()
        super().make_folder(path)

    def create(self, path: Path) -> RealFile:
        self._world.use_disk()
        return _File(path, self._world)

    def remove(self, path: Path) -> None:
        self._world.use_disk()
        super().remove(path)


class _File(RealFile):
    def __init__(self, path: Path, world: World) -> None:
        super().__init__(path)
        self._world = world

    def write(self, data: bytes) -> None:
        self._world.use_disk()
        super().write(data)

    def sync(self) -> None:
        self._world.use_disk()


class _KilledError(BaseException):
    """The owner's process is no more."""


class _OwnedMill(Mill):
    """Notes the plan and the set-up that orders rest on, and whose word the last start or recovery was."""

    world: World
    last_plan = last_setup = start_origin = ""

    def carry_out(self, doing: str, act: Callable[[Mill], Any], caller: Caller, *, needs_lease: bool = False) -> Any:
        if doing in ("start", "recover"):
            self.start_origin = caller.origin
        answer = super().carry_out(doing, act, caller, needs_lease=needs_lease)
        self.world.use_disk()  # as every look at a run does
        return answer

    def watch(self, world: World) -> None:
        self.world = world
        plan, vouch = self._planner.plan, self._starter._vouch

        def note_plan(run: Run) -> Any:
            planned = plan(run)
            self.last_plan = planned[0].digest
            return planned

        def note_setup(driver: Driver) -> None:  # before the person's word makes the position a trusted one
            self.last_setup = self._link.setup.digest(self.status, self._runs.needs())
            vouch(driver)

        self._planner.plan = note_plan  # type: ignore[method-assign]
        self._starter._vouch = note_setup  # type: ignore[method-assign]


class _OwnedThread(MillThread):
    """The owner, whose rounds are let go one by one: `turn` is one, unless a disk hangs under it."""

    def __init__(self, mill: Mill, world: World) -> None:
        super().__init__(mill)
        self._world = world
        self._round_s = 0.0
        self._hangs_until_s: float | None = None
        self._owner = greenlet(self._make_rounds)

    @property
    def hangs(self) -> bool:
        return self._hangs_until_s is not None

    @property
    def is_current(self) -> bool:
        return getcurrent() is self._owner

    def _is_running(self) -> bool:
        return not self._ended

    def halt(self, stop: Stop, caller: Caller = NOBODY) -> tuple[bool, Future[None]]:
        halted = super().halt(stop, caller)
        self._world.note_stop(caller, written=halted[0])
        return halted

    def turn(self, seconds: float) -> None:
        """Let one round go, or the rest of one that hung."""
        sim, until_s = self._world.sim, self._hangs_until_s
        if until_s is not None:
            sim.advance(min(sim.now_s + seconds, until_s))
            if sim.now_s < until_s:
                return
        self._round_s = seconds
        self._switch_to_owner()

    def hang(self, seconds: float) -> None:
        """Let time pass without the owner, in the middle of what it does."""
        self._hangs_until_s = self._world.sim.now_s + seconds
        self._owner.parent.switch()
        self._hangs_until_s = None
        if self._ending:
            raise _KilledError

    def kill(self) -> None:
        self._ending = True
        if self._owner:
            self._switch_to_owner()

    def _switch_to_owner(self) -> None:
        self._owner.parent = getcurrent()
        self._owner.switch()

    def _make_rounds(self) -> None:
        with contextlib.suppress(_KilledError):
            while not self._ending:
                self._mill.step(self._round_s)
                self._carry_out_calls()
                self._publish()
                self._owner.parent.switch()


class World:
    """The parts of one history, and its time."""

    def __init__(self, folder: Path, program: tuple[Preflight, Path]) -> None:
        self.folder = folder
        self.program = program
        self.sim = SimulatedMill(GRBL_11.with_settings({120: 3000, 121: 3000, 122: 3000}), seed=1)
        self.suspended_s = 0.0
        self.database_until_s = 0.0  # the database is locked until then
        self.hang_in, self.hang_s = -1, 0.0  # accesses to the disk until it hangs; how long it does
        self.hung = 0
        self.acts: list[Act] = []
        self._noted: dict[
            type, tuple[object, str]
        ] = {}  # what was seen last, and whose; an override goes beside a stream
        self.judged: list[str] = []
        self.loop = _SimulatedLoop(self)
        self.network = MessageNetwork(self.loop)
        self.people = People(self)
        self._numbers = itertools.count()
        (folder / "token").write_text(_TOKEN)
        (folder / "token").chmod(0o600)
        database = folder / "runs.db"
        database.write_bytes(_empty_database())
        self.database = connect(f"sqlite:///{database}")
        self.profile = load_profile("grbl")
        self._make_agent()
        self.make_server()
        self.run_id = self.agent_run = ""
        read = ProgramReader._piece

        def read_piece(reader: ProgramReader, *where: Any) -> Any:
            self.use_disk()
            return read(reader, *where)

        self._slow_reader = mock.patch.object(ProgramReader, "_piece", read_piece)
        self._slow_reader.start()

    # ------------------------------------------------------------------ time

    def now_s(self) -> float:
        """By a clock that runs in suspend."""
        return self.sim.now_s

    def advance(self, seconds: float) -> None:
        """For the loop: time passes, the mill's owner works."""
        end_s = self.sim.now_s + seconds
        while self.sim.now_s < end_s:
            self.thread.turn(min(_SLICE_S, end_s - self.sim.now_s))
            if self.loop.has_work:
                return

    def pass_s(self, seconds: float) -> None:
        self.loop.run_until_complete(asyncio.sleep(seconds))

    def pass_until_all_came(self, seconds: float) -> None:
        """Until no message and nobody who presses is waited for, but for an answer that is lost; so long at most."""
        end_s = self.sim.now_s + seconds
        while self.network.is_awaited and self.sim.now_s < end_s:
            self.pass_s(0.5)

    def use_disk(self) -> None:
        """The mill's owner reads or writes something."""
        if self.hang_in >= 0 and self.thread.is_current:
            self.hang_in -= 1
            if self.hang_in < 0:
                self.hung += 1
                self.thread.hang(self.hang_s)

    def stall_database(self, seconds: float) -> None:
        self.database_until_s = self.now_s() + seconds

    def crowd_server(self, *, strangers: bool) -> None:
        self.loop.run_until_complete(self.network.fill_server(strangers=strangers))

    def suspend(self, seconds: float) -> None:
        """Server and agent sleep; the mill and the people do not."""
        self.suspended_s += seconds
        self.sim.advance(self.sim.now_s + seconds)

    # ------------------------------------------------------------------ who is there

    def _make_agent(self) -> None:
        def open_journal(folder: Path) -> Journal:
            return Journal(folder, disk=_Disk(self), syncer=InlineSyncer(self.now_s))

        self.gate = OrderGate(
            clock=self.now_s, wall_clock=lambda: 1.8e9 + self.sim.now_s, make_secret=lambda: f"s{next(self._numbers)}"
        )
        mill = _OwnedMill(
            name=MACHINE,
            reentry=Reentry(safe_z_mm=5.0),
            connect=lambda: GrblDriver(_Tap(self)),
            folder=self.folder / "mill",
            clock=self.now_s,
            wall_clock=lambda: 1.8e9 + self.sim.now_s,
            open_journal=open_journal,
            pause=lambda seconds: self.sim.advance(self.sim.now_s + seconds),
            orders=self.gate,
            spindle_rpm=self.profile.spindle_rpm,
        )
        mill.watch(self)
        self.mill, self.thread = mill, _OwnedThread(mill, self)
        settings = AgentSettings(
            machine=MACHINE,
            port_url="memory://",
            host="127.0.0.1",
            bind_port=0,
            folder=self.folder / "mill",
            token=_TOKEN,
            token_path=None,
            token_file=self.folder / "token",
        )
        agent = Agent(
            settings=settings,
            profile=self.profile,
            access=MillAccess(self.thread),
            store=ProgramStore(self.folder / "programs", max_bytes=1 << 20),
            hub=Hub(ring=10, readers=4),
            connector=None,  # type: ignore[arg-type]
            keys=ClientKeys(self.folder / "keys.json"),
            audit=None,  # type: ignore[arg-type]
        )
        self.agent_app = httpx.ASGITransport(app=make_app(agent), client=("127.0.0.1", 1))

    def restart_agent(self) -> None:
        """Whatever it was about, a hung disk included."""
        self.hang_in = -1
        self.thread.kill()
        self.mill.close(detach=True)
        self._make_agent()

    def make_server(self) -> None:
        """A server that has just started: it remembers nothing."""
        self.core = _Core(self)
        self.orders = Orders(self.core, self.now_s)
        self.stops = Stops(self.core)
        self.controls = Controls(self.core)

    def restart_server(self) -> None:
        self.network.cancel()
        self.make_server()

    # ------------------------------------------------------------------ what leaves

    def note_written(self, data: bytes) -> None:
        """For the tap: find the first bytes of each order among what is written."""
        driver = self.mill._link.driver
        if not isinstance(driver, GrblDriver):
            return
        session = driver._session
        if b"~" in data:
            self._note_act(None)
        if (step := session.commands.override._command) is not None and data.translate(None, _OVERRIDES) != data:
            self._note_first(step)
        lines = data.translate(None, _STOPS_AND_QUESTIONS + _OVERRIDES + b"~").split(b"\n")
        if any(line not in _QUESTIONS for line in lines):
            streams = session.link.phase is Phase.STREAMING
            self._note_first(session.streamer.stream if streams else session.commands.command)

    def _note_first(self, of: object) -> None:
        before, origin = self._noted.get(type(of), (None, ""))
        if of is not before:
            self._noted[type(of)] = of, self._note_act(of)
        elif isinstance(of, Travel) and origin:
            self._add_act(origin, goes_on=True)

    def _note_act(self, of: object) -> str:
        """Note it if it is of an order: of one that is being carried out, or that was taken before. Return whose."""
        last = self.mill._commands._last
        taken = last[1].origin if last is not None and last[0] is of else ""
        if isinstance(of, Stream):
            taken = self.mill.start_origin
        if origin := (self.mill._order.caller.origin or taken):  # else made ready by us
            self._add_act(origin)
        return origin

    def _add_act(self, origin: str, *, goes_on: bool = False) -> None:
        lease, number = self.gate.get_lease(), int(origin)
        press = self.people.presses[number]
        seen = self._present(press.what) if press.seen else ""
        digest = lease.digest if lease is not None else ""
        self.acts.append(Act(number, press.what, self.now_s(), digest, seen, goes_on))

    def take_acts(self) -> list[Act]:
        """Those that were not judged yet."""
        acts, self.acts = self.acts, []
        self.judged += [self.people.presses[act.press].what + " goes on" * act.goes_on for act in acts]
        return acts

    def note_stop(self, caller: Caller, *, written: bool) -> None:
        press = self.people.stops[int(caller.origin.split()[1])]
        press.reached_s = press.reached_s or self.now_s()
        press.written = press.written or written

    def _present(self, what: str) -> str:
        return self.mill.last_plan if what == "recover" else self.mill.last_setup

    # ------------------------------------------------------------------ what is done to the mill

    def take_control(self, *, take_over: bool) -> str | None:
        """At once, with no network between: the secret."""
        with contextlib.suppress(MachineError):
            return self.gate.take_lease("Ada", "p", take_over=take_over)[0]
        return None

    def set_zero(self) -> None:
        """Somebody sets the zero at the mill itself: plan and set-up are others from now on."""
        if self.mill.status.state is MillState.IDLE and not self.thread.hangs:
            with contextlib.suppress(MachineError):
                self.mill.command(SetZero("X"))
                self.pass_s(0.3)

    def make_ready(self, what: str) -> str:
        """Bring mill and run, in calm weather, to where this order is allowed; what a person sees then.

        What is still on its way from before may come in between: then once more.
        """
        self.database_until_s, self.hang_in = 0.0, -1
        self.network.empty_server()
        for _ in range(30):  # a line that a stop has overtaken is waited for, for a minute
            with contextlib.suppress(MachineError):
                return self._try_to_make_ready(what)
            self.pass_s(3.0)
        raise AssertionError(f"the mill could not be made ready for {what}: {self.mill.snapshot}")

    def _try_to_make_ready(self, what: str) -> str:
        mill = self.mill
        self._until(lambda: not self.network.on_the_way and not self.thread.hangs)
        known = self.loop.run_until_complete(self.core.renew_link(MACHINE))
        self.loop.run_until_complete(
            known.find_address()
        )  # else the first press of a server would have messages of its own
        if mill._runs.live is not None:
            mill.abort()
        self._until(lambda: mill._runs.live is None and mill.status.state in _QUIET)
        if mill.status.state is not MillState.IDLE:
            mill.command(Reset() if mill.status.state is MillState.HELD else Unlock())
            self._until(lambda: mill.status.state is MillState.IDLE)
        if mill._spindle.may_turn:
            mill.switch_spindle(None)
        self.pass_s(0.5)
        if what in ("start", "resume run", "resume", "recover", "frame"):
            self.park()
        if what in ("go-to-zero", "frame"):
            mill.command(SetZero("XYZ"))
        if what in ("resume run", "resume", "recover"):
            mill.start_origin = ""
            mill.start(self.agent_run, Confirmation("Ada", CHECKS))
            self.pass_s(1.0)
            (mill.abort if what == "recover" else mill.hold)()
            wanted = MillState.IDLE if what == "recover" else MillState.HELD
            self._until(lambda: mill.status.state is wanted)
        self.pass_s(0.3)
        if what == "recover":
            return mill.plan_recovery(self.agent_run).digest
        return self.thread.snapshot.setup if what == "start" else ""

    def _until(self, true: Callable[[], bool]) -> None:
        for _ in range(1500):
            if true():
                return
            self.pass_s(0.1)
        raise AssertionError(f"the mill did not come to where it should: {self.mill.snapshot}")

    def park(self) -> None:
        facts, path = self.program
        view = self.mill.park(facts, path, "part")
        self.run_id, self.agent_run = f"run-{next(self._numbers)}", view.id
        row = {"id": self.run_id, "machine": MACHINE, "job_id": "j", "program": "p", "number": 1, "sha256": "0" * 64}
        row |= {"agent_run": view.id, "state": "parked", "open": True, "view": view.as_dict(), "words": ""}
        with self.database.begin() as connection:
            connection.execute(sa.update(runs).values(open=False))
            connection.execute(sa.insert(runs).values(**row, created_by="p", created_at=self.now_s()))

    def close(self) -> None:
        for task in asyncio.all_tasks(self.loop):
            task.cancel()
        self.pass_s(0.01)
        self._slow_reader.stop()
        self.thread.kill()
        with contextlib.suppress(Exception):
            self.mill.close(detach=True)
        self.loop.close()
        self.database.dispose()


class _AgentTransport(httpx.AsyncBaseTransport):
    """From the server to the agent of this moment."""

    def __init__(self, world: World) -> None:
        self._world = world

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        content = await request.aread()

        async def deliver() -> httpx.Response:
            copy = httpx.Request(request.method, request.url, headers=request.headers, content=content)
            answer = await self._world.agent_app.handle_async_request(copy)
            return httpx.Response(answer.status_code, headers=answer.headers, content=await answer.aread())

        answer: httpx.Response = await self._world.network.hop(deliver)
        return httpx.Response(answer.status_code, headers=answer.headers, stream=httpx.ByteStream(answer.content))


class _Core(FleetCore):
    """The database is as slow as the weather says; nothing runs in a thread."""

    def __init__(self, world: World) -> None:
        self._world = world
        super().__init__(ServerSettings(data=world.folder), world.database, None, None)  # type: ignore[arg-type]
        self._http = httpx.AsyncClient(transport=_AgentTransport(world), base_url="http://127.0.0.1")

    async def do(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        await asyncio.sleep(max(0.0, self._world.database_until_s - self._world.now_s()))
        return function(*arguments, **named)

    async def list_machines(self) -> tuple[dict[str, KnownMachine], list[str]]:
        return await self.do(self._list_machines)

    def _list_machines(self) -> tuple[dict[str, KnownMachine], list[str]]:
        token = self._world.folder / "token"
        known = KnownMachine(name=MACHINE, profile=self._world.profile, url="http://127.0.0.1:1", token_file=token)
        return {MACHINE: known}, []

    async def renew_link(self, machine: str) -> Any:
        return self.get_link(self._list_machines()[0][machine])


class _SimulatedLoop(asyncio.SelectorEventLoop):
    """Its clock is the simulated mill's, less what was slept away; waiting for input is letting the mill go on."""

    def __init__(self, world: World) -> None:
        super().__init__(_Waiting(world))
        self._world = world

    def time(self) -> float:
        return self._world.sim.now_s - self._world.suspended_s

    @property
    def has_work(self) -> bool:
        return bool(self._ready)  # type: ignore[attr-defined]


class _Waiting(selectors.SelectSelector):
    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world

    def select(self, timeout: float | None = None) -> Any:
        if timeout is None or timeout > 0:
            self._world.advance(1.0 if timeout is None else timeout)
        return super().select(0)
