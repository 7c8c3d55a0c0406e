"""One attempt of one job: its stages in order, each reused, or run in a process of its own and committed; and what all
attempts of a worker share.

The engine calls it as often as necessary. It returns once the job has ended, for any reason. It raises `Fenced` if this
worker must not go on now; another call, here or elsewhere, then continues after the last committed stage. A stage that
crashes is tried again. A database that is away for a while costs no work.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import sqlalchemy as sa
import structlog

from phrases.phrase import Phrase, join
from service.errors import FailedError, ServiceError, printable
from service.job.spec.loading import restore_job
from service.job.stages.order import FileRef, PictureLimits, StageOrder, StageResult
from service.job.stages.table import JobSoFar, shares, stage_key
from service.server.database.claims import STOPPED, Claim, StageClose, StageTry, WorkBook
from service.server.database.records import JobState, StageState
from service.server.queue.engine import Busy, Fenced, Ticket
from service.server.worker.lease import Lease, Watch, Watched
from service.server.worker.stage_process import Crashed, Done, Failed, Refused, StageEnd, Stopped
from service.settings import ServerSettings
from service.store.base import MissingObjectError, Store

RETRY_S = 600.0
PAUSE_S = 0.2
AWAY = (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.InternalError, sa.exc.TimeoutError)
Result = TypeVar("Result")


class Processes(Protocol):
    """The part of StageProcesses that an attempt uses."""

    def run(
        self, order: Any, *, log: Path, on_progress: Callable[[float], None], stop: Callable[[], str | None]
    ) -> StageEnd: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class WorkerContext:
    """The parts that all jobs of a worker share."""

    settings: ServerSettings
    executor: str
    work: WorkBook
    store: Store
    processes: Processes
    lease: Lease
    watch: Watch

    @property
    def scratch(self) -> Path:
        """The folder in which this worker's stages work; no other worker uses it."""
        return self.settings.scratch / self.executor


@contextmanager
def fence_outage() -> Iterator[None]:
    """Fence an attempt if the database cannot be reached: it is not the job's fault, and the job continues later."""
    try:
        yield
    except AWAY as error:
        raise Fenced(f"the database is away: {str(error).splitlines()[0]}") from error


def retry_while_away(write: Callable[[], Result]) -> Result:
    """Retry while the database is away, so that its restart does not cost hours of work."""
    deadline = time.monotonic() + RETRY_S
    while True:
        try:
            return write()
        except AWAY:
            if time.monotonic() > deadline:
                raise
            time.sleep(PAUSE_S)


STAGE_TRIES = 3  # of a stage whose process ends without a result
log = structlog.get_logger()


class StageRunner:
    """Runs the stages in order; `_files` are the files that they have made."""

    def __init__(self, context: WorkerContext, claim: Claim, watched: Watched) -> None:
        self._context = context
        self._claim = claim
        self._watched = watched
        self._so_far = JobSoFar(restore_job(claim.job.spec, claim.job.figures))
        self._shares = shares(self._so_far.job.spec)
        self._done_share = 0.0
        self._files: dict[str, FileRef] = {}

    def run(self) -> None:
        """Run every stage, then end the job; a stage that fails or is cancelled ends it earlier."""
        for stage in self._so_far.stages():
            with structlog.contextvars.bound_contextvars(stage=stage):
                result = self._run_or_reuse(stage)
            if result is None:
                return
            self._done_share = self._job_share(stage, 1.0)
            self._files |= result.outputs
            self._so_far.add(result.report, result.notes)
            self._shares = shares(self._so_far.job.spec)
        self._finish(JobState.SUCCEEDED, report=self._so_far.report)

    def _run_or_reuse(self, stage: str) -> StageResult | None:
        """Reuse equal work done before, or run the stage; None if the job has ended here."""
        key = stage_key(
            stage,
            self._so_far.job,
            image_sha256=self._claim.job.image_sha256,
            image_name=self._claim.job.name,
            outputs=self._files,
        )
        if (result := self._reuse(stage, key)) is not None:
            return result
        while True:
            if (reason := self._watched.reason()) is not None:
                self._end_stopped_job(reason, None, None)
                return None
            begun = retry_while_away(lambda: self._context.work.begin_stage(self._claim, stage, key))
            path = self._scratch(begun, "log")
            end = self._run(begun, path)
            record = self._store_log(path)
            match end:
                case Done(plain):
                    return self._commit(begun, StageResult.from_plain(plain), record)
                case Crashed(words) if self._count_crashes(stage) < STAGE_TRIES - 1:
                    self._close(begun, StageState.INTERRUPTED, words, record)
                case Stopped(reason):
                    self._end_stopped_job(reason, begun, record)
                    return None
                case _:
                    self._fail(begun, end, record)
                    return None

    def _reuse(self, stage: str, key: str) -> StageResult | None:
        found = self._context.work.find_result(key)
        if found is None:
            return None
        try:
            for file in found.outputs.values():
                self._context.store.head(file.sha256)
        except MissingObjectError as error:
            log.warning("a finished stage has lost a file; it is done again", sha256=error.sha256)
            self._context.work.forget_result(key)
            return None
        return self._context.work.reuse_stage(self._claim, stage, key, whole=self._job_share(stage, 1.0))

    def _run(self, begun: StageTry, path: Path) -> StageEnd:
        log.info("stage begins", number=begun.number)
        path.unlink(missing_ok=True)
        job = self._claim.job
        order = StageOrder(
            job_id=job.id,
            attempt=job.attempt,
            stage=begun.stage,
            spec=self._so_far.job.spec.model_dump(mode="json"),
            figures=self._so_far.job.figures.to_text(),
            image_sha256=job.image_sha256,
            image_name=job.name,
            scratch=str(self._scratch(begun, "d")),
            inputs=self._files,
            report=self._so_far.report,
            notes=self._so_far.notes,
            limits=PictureLimits(max_pixels=self._context.settings.max_pixels),
        )

        def on_progress(share: float) -> None:
            self._watched.news = (begun.stage, share, self._job_share(begun.stage, share))

        try:
            end = self._context.processes.run(order, log=path, on_progress=on_progress, stop=self._watched.reason)
        finally:
            self._watched.news = None
            shutil.rmtree(order.scratch, ignore_errors=True)  # a process that was killed has left it behind
        log.info("stage ends", number=begun.number, end=type(end).__name__)
        return end

    def _commit(self, begun: StageTry, result: StageResult, record: FileRef | None) -> StageResult:
        whole = self._job_share(begun.stage, 1.0)
        retry_while_away(lambda: self._context.work.commit_stage(self._claim, begun, result, log=record, whole=whole))
        return result

    def _end_stopped_job(self, reason: str, begun: StageTry | None, record: FileRef | None) -> None:
        """End a stopped stage. If it was cancelled the job ends too; otherwise it goes on elsewhere, or here later."""
        if reason == "cancelled":
            if begun is not None:
                self._close(begun, StageState.CANCELLED, "cancelled", record)
            self._finish(JobState.CANCELLED)
            return
        if reason == "stopping" and begun is not None:
            self._close(begun, StageState.INTERRUPTED, STOPPED, record)
        raise Fenced(reason)

    def _fail(self, begun: StageTry, end: StageEnd, record: FileRef | None) -> None:
        field: str | None = None
        match end:
            case Refused(lines, name):
                words, field = join("\n", map(printable, lines)), name or None
            case Failed(lines):
                words = join("\n", map(printable, lines))
            case Crashed(crash):
                words = Phrase(
                    "it ended {count} times without a result: {cause}", count=STAGE_TRIES, cause=printable(crash)
                )
            case _:
                words = Phrase("it ended in the state {end}", end=str(end))
        self._close(begun, StageState.FAILED, words, record)
        self._finish(JobState.FAILED, error={"stage": begun.stage, "detail": words, "field": field})

    def _finish(self, state: JobState, **values: Any) -> None:
        log.info("job ends", state=str(state))
        retry_while_away(lambda: self._context.work.finish(self._claim, state, **values))

    def _close(self, begun: StageTry, state: StageState, words: str, record: FileRef | None) -> None:
        log.info("stage made nothing", number=begun.number, state=str(state), words=words)
        close = StageClose(state=state, words=words, log=record)
        retry_while_away(lambda: self._context.work.end_stage(self._claim, begun, close))

    def _count_crashes(self, stage: str) -> int:
        return retry_while_away(lambda: self._context.work.count_crashes(self._claim, stage))

    def _store_log(self, path: Path) -> FileRef | None:
        """Store the output of the stage's process and return it; None if there is none."""
        try:
            if path.stat().st_size == 0:
                return None
            stored = self._context.store.put_file(path)
            return FileRef(stored.sha256, stored.bytes)
        except (OSError, FailedError):  # a full disk: the stage matters more than its log
            return None
        finally:
            path.unlink(missing_ok=True)

    def _job_share(self, stage: str, share: float) -> float:
        """Return the share of the job that is done when this stage is at `share`."""
        return min(1.0, self._done_share + share * self._shares[stage])

    def _scratch(self, begun: StageTry, kind: str) -> Path:
        return self._context.scratch / f"{self._claim.job.id}-{begun.id}.{kind}"


MEGA = 1_000_000


class Attempt:
    """Attempts at jobs. The engine calls it with each ticket, from several threads."""

    def __init__(self, context: WorkerContext) -> None:
        self._context = context
        self._slots = threading.BoundedSemaphore(context.settings.slots)
        self._active: set[str] = set()
        self._lock = threading.Lock()
        self._disk_is_full = False

    def __call__(self, ticket: Ticket) -> None:
        ids = structlog.contextvars.bound_contextvars(job=ticket.job_id, attempt=ticket.attempt)
        with ids, self._hold_slot(), self._hold_job(ticket), fence_outage():
            self._require_fitness()
            claim = self._context.work.claim(ticket, self._context.executor)
            if claim is not None:
                self._run(claim)

    def list_active(self) -> set[str]:
        """List the ids of the jobs that this worker works on, including those it may be claiming just now."""
        with self._lock:
            return set(self._active)

    def _run(self, claim: Claim) -> None:
        with self._context.watch.follow(claim) as watched:
            try:
                StageRunner(self._context, claim, watched).run()
            except (Fenced, *AWAY):
                raise
            except ServiceError as error:
                self._fail(claim, {"stage": None, "detail": str(error), "field": None})
            except Exception:
                log.exception("fault of the worker")
                words = Phrase("internal server error; see the server's log")
                self._fail(claim, {"stage": None, "detail": words, "field": None})

    def _fail(self, claim: Claim, error: dict[str, object]) -> None:
        retry_while_away(lambda: self._context.work.finish(claim, JobState.FAILED, error=error))

    def _require_fitness(self) -> None:
        """Refuse to begin without a lease, while stopping, or on a full disk."""
        context = self._context
        if context.watch.stopping.is_set() or not context.lease.is_safe():
            raise Fenced("this worker may not work now")
        needed_mb, was_full = context.settings.free_disk_mb, self._disk_is_full
        self._disk_is_full = shutil.disk_usage(context.settings.data).free < needed_mb * MEGA
        if self._disk_is_full:
            if not was_full:
                log.warning("jobs wait: too little free disk space", needed_mb=needed_mb)
            raise Fenced("too little free disk space")

    @contextmanager
    def _hold_slot(self) -> Iterator[None]:
        """Hold a slot. The engine also counts slots, but may hand out one too many while a ticket is on its way to a
        thread.
        """
        if not self._slots.acquire(blocking=False):
            raise Busy("all slots are taken")
        try:
            yield
        finally:
            self._slots.release()

    @contextmanager
    def _hold_job(self, ticket: Ticket) -> Iterator[None]:
        """Hold the job: this process makes one call per job at a time, even if the engine asks for two."""
        with self._lock:
            if ticket.job_id in self._active:
                raise Fenced("it runs here already")
            self._active.add(ticket.job_id)
        try:
            yield
        finally:
            with self._lock:
                self._active.remove(ticket.job_id)
