"""The way of one claimed job through its stages; one that crashes is tried again."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import structlog

from phrases.phrase import Phrase, join
from service.errors import FailedError, printable
from service.job.spec.loading import restore_job
from service.job.stages.order import FileRef, PictureLimits, StageOrder, StageResult
from service.job.stages.table import JobSoFar, shares, stage_key
from service.server.database.claims import STOPPED, Claim, StageClose, StageTry
from service.server.database.states import JobState, StageState
from service.server.queue.engine import Fenced
from service.server.worker.context import WorkerContext, retry_while_away
from service.server.worker.monitor import Watched
from service.server.worker.process.supervision import Crashed, Done, Failed, Refused, StageEnd, Stopped
from service.store.base import MissingObjectError

STAGE_TRIES = 3  # of a stage whose process ends without a result
log = structlog.get_logger()


class StageRunner:
    """Stages in order; `_files` are those that they have made."""

    def __init__(self, context: WorkerContext, claim: Claim, watched: Watched) -> None:
        self._context = context
        self._claim = claim
        self._watched = watched
        self._so_far = JobSoFar(restore_job(claim.job.spec, claim.job.figures))
        self._shares = shares(self._so_far.job.spec)
        self._done_share = 0.0
        self._files: dict[str, FileRef] = {}

    def run(self) -> None:
        """Run every stage, then end the job; or end it on the way."""
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
        """Reuse equal work done before, or run the stage; None where the job has ended here."""
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
                self._end_stopped(reason, None, None)
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
                    self._end_stopped(reason, begun, record)
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
            shutil.rmtree(order.scratch, ignore_errors=True)  # a process that was killed could not
        log.info("stage ends", number=begun.number, end=type(end).__name__)
        return end

    def _commit(self, begun: StageTry, result: StageResult, record: FileRef | None) -> StageResult:
        whole = self._job_share(begun.stage, 1.0)
        retry_while_away(lambda: self._context.work.commit_stage(self._claim, begun, result, log=record, whole=whole))
        return result

    def _end_stopped(self, reason: str, begun: StageTry | None, record: FileRef | None) -> None:
        """End a stopped stage. Cancelled: the job ends, too. Otherwise it goes on elsewhere, or here at another
        time.
        """
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
        """Return what the stage's process said, put into the store; None where it said nothing."""
        try:
            if path.stat().st_size == 0:
                return None
            stored = self._context.store.put_file(path)
            return FileRef(stored.sha256, stored.bytes)
        except (OSError, FailedError):  # a full disk: the stage is worth more than its words
            return None
        finally:
            path.unlink(missing_ok=True)

    def _job_share(self, stage: str, share: float) -> float:
        """Return how far the job is, where this stage is at `share`."""
        return min(1.0, self._done_share + share * self._shares[stage])

    def _scratch(self, begun: StageTry, kind: str) -> Path:
        return self._context.scratch / f"{self._claim.job.id}-{begun.id}.{kind}"
