"""Starts and stops the agent. It starts with its address, then the folder, then the port, and the mill's thread last.

So a second agent ends in one clear line before anything has been sent to a mill. A stop (SIGTERM, SIGINT, SIGHUP)
while the mill moves holds it first; the process ends only when the mill stands, or when it cannot be reached.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import uvicorn

from machines.driver import MillState
from machines.errors import PortError
from machines.mill.mill import Mill
from machines.mill.orders import Caller, Stop
from machines.mill.thread import MillThread
from machines.profile import MachineProfile
from machines.recovery.plan_model import Reentry
from machines.runs import RunState
from service.errors import printable
from service.http.admission import Admission
from service.http.event_hub import Hub, Reader
from service.http.hosts import bind_address
from service.http.uvicorn_protocol import HEADER_BYTES, HttpServer, allow_open_files
from service.milling.agent.agent import Agent, ClientKeys, MillAccess
from service.milling.agent.app import make_app
from service.milling.agent.card import announce
from service.milling.agent.programs import ProgramStore
from service.milling.agent.reporting import AuditLog, SnapshotFeed
from service.milling.agent.settings import AgentSettings, report_disk_errors
from service.milling.connect import Connector
from service.processes.linux import go_first

_STOPPING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_MOVING = (MillState.RUN, MillState.HOLDING, MillState.JOG, MillState.HOMING)
_GOING = (RunState.RUNNING, RunState.RECOVERING, RunState.HOLDING, RunState.STOPPING)
_STANDSTILL_S = 10.0
_DRAIN_S = 2
_CONNECTIONS, _STRANGERS = 200, 100
_EVENTS, _READERS = 1000, 32
_MOST_PROGRAM_BYTES = 4 << 30
_FILES = 1024
CatchStop = Callable[[], AbstractContextManager[asyncio.Event]]


def run_agent(settings: AgentSettings, profile: MachineProfile, *, catch_stop: CatchStop | None = None) -> None:
    """Serve until a signal, or another event that `catch_stop` listens to, ends it."""
    go_first()
    with contextlib.ExitStack() as stack:
        allow_open_files(_FILES)
        logging.getLogger("uvicorn.error").setLevel(logging.ERROR)  # a warning for each bad request could fill a disk
        bound = bind_address(settings.host, settings.bind_port, option="--bind-port", backlog=64)
        listener = stack.enter_context(contextlib.closing(bound))
        connector = Connector(profile, settings.port_url)
        reentry = Reentry(safe_z_mm=profile.safe_z_mm)
        with report_disk_errors(settings.folder):
            mill = Mill(
                name=settings.machine,
                connect=connector,
                folder=settings.folder,
                reentry=reentry,
                spindle_rpm=profile.spindle_rpm,
            )
        thread = MillThread(mill)
        stack.callback(thread.stop, detach=True)
        stack.callback(connector.close_unused)
        _open_first_link(connector, settings.port_url)
        thread.start()
        asyncio.run(_serve(settings, profile, connector, thread, listener, catch_stop or _catch_stop_signals))


def _open_first_link(connector: Connector, url: str) -> None:
    """Open the port now. A busy or invalid port ends the agent; the agent waits for a missing one."""
    try:
        connector.open_now()
    except PortError as error:
        if not (url.startswith("/") and not Path(url).exists()):
            raise
        print(f"{error}; waiting for it", file=sys.stderr, flush=True)


async def _serve(
    settings: AgentSettings,
    profile: MachineProfile,
    connector: Connector,
    thread: MillThread,
    listener: socket.socket,
    catch_stop: CatchStop,
) -> None:
    access = MillAccess(thread)
    hub: Hub[Reader] = Hub(ring=_EVENTS, readers=_READERS)
    audit = AuditLog(settings.folder / "orders")
    store = ProgramStore(settings.folder / "programs", max_bytes=_MOST_PROGRAM_BYTES)
    agent = Agent(
        settings=settings,
        profile=profile,
        access=access,
        store=store,
        hub=hub,
        connector=connector,
        keys=ClientKeys(settings.folder / "client-keys.json"),
        audit=audit,
    )
    watch = SnapshotFeed(thread, asyncio.get_running_loop(), hub, audit)
    server = _Server(
        uvicorn.Config(
            make_app(agent),
            ws="none",
            h11_max_incomplete_event_size=HEADER_BYTES,
            log_config=None,
            log_level="warning",
            access_log=False,
            lifespan="off",
            server_header=False,
            timeout_keep_alive=60,
            timeout_graceful_shutdown=_DRAIN_S,
        ),
        Admission(most=_CONNECTIONS, strangers=_STRANGERS),
    )
    watch.start()
    try:
        with catch_stop() as stop, _announce(settings, listener):
            serving = asyncio.ensure_future(server.serve(sockets=[listener]))
            stopping = asyncio.ensure_future(stop.wait())
            await asyncio.wait({serving, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if stop.is_set():
                stop.clear()
                await _stand_still(access, stop)
            stopping.cancel()
            hub.close()
            server.should_exit = True
            await serving
    finally:
        watch.stop()
        access.close()
        audit.close()


class _Server(HttpServer):
    """uvicorn without its signal handlers: ours hold the mill first."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


@contextlib.contextmanager
def _catch_stop_signals() -> Iterator[asyncio.Event]:
    """Yield an event that every signal that stops the agent sets; restore the previous handlers at the end."""
    loop, stop = asyncio.get_running_loop(), asyncio.Event()
    found = {kind: signal.getsignal(kind) for kind in _STOPPING}
    before = {
        kind: handler for kind, handler in found.items() if handler is not signal.SIG_IGN
    }  # a signal ignored by nohup stays ignored
    for kind in before:
        loop.add_signal_handler(kind, stop.set)
    try:
        yield stop
    finally:
        for kind, handler in before.items():
            loop.remove_signal_handler(kind)
            signal.signal(kind, handler)


async def _stand_still(access: MillAccess, again: asyncio.Event) -> None:
    """Hold a mill that moves and wait until it stands; a second signal ends the waiting."""
    if not _moves(access):
        return
    print("stopping: feed hold", file=sys.stderr, flush=True)
    await access.halt(Stop.HOLD, Caller(name="the agent, at its end"))
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_STANDSTILL_S):
            while _moves(access) and not again.is_set():
                await asyncio.sleep(0.02)
    if _moves(access):
        words = "the mill was sent a hold and has not reported that it stands: LOOK AT IT, use its own stop button"
    else:
        words = "the mill stands in feed hold; its spindle may turn still"
    print(f"{words}. The run can be recovered after a new start of this agent", file=sys.stderr, flush=True)


def _moves(access: MillAccess) -> bool:
    """Return whether the mill moves, by the last report or by a run that was started since."""
    run, state = access.snapshot.run, access.snapshot.status.state
    return state in _MOVING or (run is not None and run.state in _GOING)


@contextlib.contextmanager
def _announce(settings: AgentSettings, listener: socket.socket) -> Iterator[None]:
    """Announce the agent to the person at the terminal, and to the job server on this computer."""
    address = listener.getsockname()[:2]
    card = announce(settings.folder, machine=settings.machine, address=address, token_file=settings.token_file)
    with card:
        host, port = address
        shown = f"[{host}]" if ":" in host else host
        print(f"agent of {printable(settings.machine)} on http://{shown}:{port}", flush=True)
        if settings.token_path is not None:
            print(f"token: {settings.token_path}", flush=True)
        print(f"journal and programs: {settings.folder}", flush=True)
        yield
