"""The API process: `python -m service.server.api.main`, configured by the environment.

It never computes and never migrates. Prints one line when it serves. On SIGTERM or SIGINT it accepts no new
connections, ends streams, and gives requests five seconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import uvicorn
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import Receive, Scope, Send

from machines.clock import Timeout
from service.errors import EXIT_FAILURE, ServiceError
from service.http.admission import Admission
from service.http.hosts import bind_address, own_names, url_of
from service.http.serving import make_admission, make_config
from service.http.uvicorn_protocol import HttpServer, allow_open_files
from service.logs import configure_logs
from service.processes import lifeline
from service.processes.files import keep_private
from service.server.api.access.guard import refuse_foreign_bind
from service.server.api.access.stop_access import StopAccess
from service.server.api.app import make_app
from service.server.api.event_feed import Feed
from service.server.api.intake.child_requests import LOOKING, Estimator, PictureChecker
from service.server.api.intake.form import sweep_uploads
from service.server.api.monitoring import Metrics, Readiness
from service.server.api.services import Services
from service.server.database.jobs import JobBook
from service.server.database.pairing import PairingBook
from service.server.database.schema import await_schema, open_database
from service.server.database.tokens import TokenBook
from service.server.fleet.fleet import Fleet
from service.server.pairing_code import CodeOnTerminal
from service.server.queue.dbos import DbosEngine
from service.server.standby.line import receive_connections
from service.server.stop_socket import StopSockets
from service.server.stoppers import FILE as STOPPERS
from service.settings import ServerSettings
from service.store.opening import open_store

_SCHEMA_WAIT_S = 20.0
_DRAIN_S = 5
_THREADS = 40
_FILES = 8192  # connections and open artifacts; the usual limit of 1024 is soon reached
_CALM_S = 3.0  # after which a server that has just started begins work that no one waits for
_STUCK_S = 10.0


def main() -> int:
    for kind in (signal.SIGTERM, signal.SIGINT):  # uvicorn raises it once more when it has served: then all is closed
        signal.signal(kind, lambda *_: sys.exit(0))
    try:
        settings = ServerSettings.load()
        offer = os.environ.pop(lifeline.PAIRING_OFFER, "")
        configure_logs(settings.log_level, form=settings.log_format, process="api")
        for name in ("uvicorn.error", "python_multipart"):  # a warning for each malformed request could fill a disk
            logging.getLogger(name).setLevel(logging.ERROR)
        allow_open_files(_FILES)
        listener = lifeline.inherit_socket() or bind_address(settings.host, settings.port)
        line = lifeline.inherit_line()
        url = url_of(listener)
        with contextlib.closing(listener), open_services(settings, offer, url) as services:
            asyncio.run(_serve(services, listener, line))
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return error.exit_code
    except SQLAlchemyError as error:
        reason = " ".join(str(getattr(error, "orig", error)).split())
        print(f"error: the database cannot be used: {reason}", file=sys.stderr, flush=True)
        return EXIT_FAILURE
    return 0


@contextlib.contextmanager
def open_services(settings: ServerSettings, offer: str = "", url: str = "") -> Iterator[Services]:
    """Open everything the routes need, closed at the end. InputError if it would not be safe to serve.

    offer : of a code with which pages can be paired. url : where the page is
    """
    with contextlib.ExitStack() as stack:
        keep_private(settings.data)
        database = open_database(settings)
        stack.callback(database.dispose)
        await_schema(database, _SCHEMA_WAIT_S)
        tokens = TokenBook(database)
        refuse_foreign_bind(settings, tokens)
        sweep_uploads(settings.data / "uploads")
        pairings = PairingBook(database, tokens)
        if offer:
            pairings.offer(offer)
        store = open_store(settings)
        book = JobBook(database, store)
        engine = DbosEngine(settings)
        stack.callback(engine.close)
        pictures = PictureChecker()
        stack.callback(pictures.close)
        estimates = Estimator()
        stack.callback(estimates.close)
        exact_estimates = Estimator()
        stack.callback(exact_estimates.close)
        looks = Estimator(module=LOOKING, what="look")
        stack.callback(looks.close)
        stop_access = StopAccess(tokens, settings.data / STOPPERS)
        stack.callback(stop_access.close)
        fleet = Fleet(settings, database, store, book)
        yield Services(
            settings=settings,
            database=database,
            book=book,
            store=store,
            engine=engine,
            tokens=tokens,
            pairings=pairings,
            stop_access=stop_access,
            stop_sockets=StopSockets(
                fleet.stops,
                stop_access.find,
                names=own_names(settings.allowed_hosts),
                behind_proxy=settings.behind_proxy,
            ),
            terminal=CodeOnTerminal(pairings, offer, url),
            fleet=fleet,
            pictures=pictures,
            estimates=estimates,
            exact_estimates=exact_estimates,
            looks=looks,
            feed=Feed(book),
            metrics=Metrics(database),
            readiness=Readiness(settings, database, store),
        )


async def _serve(services: Services, listener: socket.socket, line: socket.socket | None) -> None:
    """Serve until SIGTERM. line: to the standby, which serves stops while this process does not"""

    def begin() -> None:
        print(f"causticmill on {url_of(listener)}", flush=True)
        if line is not None:
            receive_connections(line, server.begin)
            lifeline.say(line, lifeline.SERVING)

    def end() -> None:
        if line is not None:
            lifeline.say(line, lifeline.GONE)

    server = server_of(services, begin, end)
    if services.settings.prepare:
        loop = asyncio.get_running_loop()
        loop.call_later(_CALM_S, loop.run_in_executor, None, services.estimates.prepare)
    turning = asyncio.create_task(_send_beats(server, line))
    gc.freeze()  # all present objects stay: no need to scan them again and again
    await server.serve(sockets=[listener])
    turning.cancel()


async def _send_beats(server: Server, line: socket.socket | None) -> None:
    """Send heartbeats to supervisor and standby while the event loop runs; a process that hangs is restarted."""
    hang = Timeout(_STUCK_S, most_s=2.0 * lifeline.BEAT_S)  # checked with every heartbeat
    lifeline.healthy = lambda: not hang.is_over
    while True:
        await asyncio.sleep(lifeline.SERVING_EVERY_S)
        hang.restart()
        if line is not None and server.serves:
            lifeline.say(line, lifeline.SERVING)


def server_of(
    services: Services,
    on_ready: Callable[[], None] = lambda: None,
    on_end: Callable[[], None] = lambda: None,
    *,
    admission: Admission | None = None,
) -> Server:
    """Configure uvicorn; `on_ready` is called once it serves, `on_end` when it stops accepting.

    admission : None for the usual places
    """
    app = make_app(services)

    async def serve(scope: Scope, receive: Receive, send: Send) -> None:
        """Route WebSockets around all middleware: strangers may open them, so they must be cheap."""
        await (services.stop_sockets if scope["type"] == "websocket" else app)(scope, receive, send)

    config = make_config(serve, lifespan="on", timeout_graceful_shutdown=_DRAIN_S)
    return Server(config, admission or make_admission(), services, on_ready, on_end)


class Server(HttpServer):
    """Announces when it serves. At a stop it first ends the streams, which would never end by themselves."""

    def __init__(
        self,
        config: uvicorn.Config,
        admission: Admission,
        services: Services,
        on_ready: Callable[[], None],
        on_end: Callable[[], None],
    ) -> None:
        super().__init__(config, admission)
        self._services = services
        self._on_ready = on_ready
        self._on_end = on_end

    @property
    def serves(self) -> bool:
        return self.started and not self.should_exit

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="api")
        asyncio.get_running_loop().set_default_executor(threads)
        await super().serve(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._on_ready()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._on_end()
        self._services.feed.close()
        self._services.fleet.end_streams()
        await super().shutdown(sockets)


if __name__ == "__main__":
    sys.exit(main())
