"""The worker's process: `python -m service.server.worker.main`, configured by the environment (service/settings.py).

Brings the database up to date, makes sure that it is the only worker of its name, and runs jobs until SIGTERM.

Theory of operation: if jobs are waiting, the fork server is started first: on another core, its imports take as long as
everything else here. So nothing heavy is imported at the top.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import sqlite3
import sys
import threading
from contextlib import closing

from service.errors import FailedError, ServiceError
from service.processes.files import keep_private
from service.server.worker.stage_process import STAGE_ENTRY, StageProcesses
from service.settings import ServerSettings


def main(*, entry: str = STAGE_ENTRY) -> int:
    """Run until stopped; if it cannot start, print one line on stderr and return an exit code. entry: of the stages."""
    end = catch_stop()
    try:
        settings = ServerSettings.load()
        keep_private(settings.data)  # before the process from which stages are forked
        processes = StageProcesses(settings, entry=entry)
        try:
            if _has_waiting_jobs(settings):
                processes.warm()
            _work(settings, processes, end, prepare=settings.prepare and entry == STAGE_ENTRY)
        finally:
            processes.close()
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return error.exit_code
    # The engine's threads wait for tickets that this worker has left for its next start, so they are not joined.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def catch_stop() -> socket.socket:
    """Return a socket that becomes readable when a signal asks this process to stop.

    The interpreter's own handler writes to it. A Python handler (one that sets an event or fills a queue) would not do:
    if the signal comes just before the wait begins, the wait would never end.
    """
    ours, its = socket.socketpair()
    its.setblocking(False)
    signal.set_wakeup_fd(its.detach(), warn_on_full_buffer=False)
    for kind in (signal.SIGTERM, signal.SIGINT):
        signal.signal(kind, lambda *_: None)
    return ours


def _work(settings: ServerSettings, processes: StageProcesses, end: socket.socket, *, prepare: bool) -> None:
    import sqlalchemy as sa

    from service.logs import configure_logs
    from service.server.worker import warmup
    from service.server.worker.worker import executor_name, open_worker

    configure_logs(settings.log_level, form=settings.log_format, executor=executor_name(settings))
    try:
        with open_worker(settings, processes) as worker:
            worker.start()
            print(f"ready: worker {worker.context.executor}", flush=True)
            if prepare:
                threading.Thread(target=warmup.compile_for_jobs, name="warm-up", daemon=True).start()
            gc.freeze()  # all present objects stay: no need to scan them again and again
            end.recv(1)
            worker.stop()
    except sa.exc.SQLAlchemyError as error:
        reason = str(getattr(error, "orig", None) or error).splitlines()[0]
        raise FailedError(f"the database cannot be used: {reason}") from None


def _has_waiting_jobs(settings: ServerSettings) -> bool:
    """Return whether jobs are waiting, without any library, if the database is a file; otherwise False."""
    try:
        with closing(sqlite3.connect(f"file:{settings.sqlite}?mode=ro", uri=True, timeout=0.1)) as database:
            query = "SELECT 1 FROM jobs WHERE state IN ('queued', 'running') LIMIT 1"
            return database.execute(query).fetchone() is not None
    except sqlite3.Error:
        return False


if __name__ == "__main__":
    sys.exit(main())
