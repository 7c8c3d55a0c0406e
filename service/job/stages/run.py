"""Runs one stage in a separate process: its inputs come from the artifact store, and its outputs go there."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from phrases.phrase import Phrase
from service.errors import FailedError, ServiceError, SpecError, sentence_of_os_error
from service.job.errors import translate_errors
from service.job.planning.fit import check_disk_space
from service.job.spec.loading import restore_job
from service.job.spec.resolve import cam_passes_of, cam_stock_of
from service.job.stages.context import PictureQueue, StageContext, peak_rss_mb
from service.job.stages.order import FileRef, StageOrder, StageResult
from service.job.stages.table import Stage, reads, stage_of
from service.progress import Stopwatch
from service.store.base import MissingObjectError, Store

_PICTURE = ".picture"  # the person's own file


def run_order(
    order: StageOrder, store: Store, on_progress: Callable[[float], None], *, plans: Path | None = None
) -> StageResult:
    """Do the whole work of a stage; return its result once all of it is in the store. plans: of `StageContext`.

    JobError in words that name files as the person knows them. The scratch folder is removed in every case.
    """
    begun = time.perf_counter()
    stage, scratch = stage_of(order.stage), Path(order.scratch)
    on_progress(0.0)
    with _hide_paths(scratch), _scratch_folder(scratch), PictureQueue() as picture_queue:
        context = _make_context(order, stage, scratch, Stopwatch(_Shares(stage, on_progress)), picture_queue, plans)
        fetched = _fetch(order, stage, store, scratch)
        if stage.number:
            _require_space(context)
        with translate_errors():
            stage.load()(context)
            picture_queue.finish()
        outputs = _put(scratch, fetched, store)
    peak_mb = peak_rss_mb()
    context.report.update(timings_s=dict(context.watch.timings_s), peak_rss_mb=peak_mb)
    on_progress(1.0)
    return StageResult(
        outputs=outputs,
        report=context.finish_report(),
        notes=context.notes,
        seconds=round(time.perf_counter() - begun, 3),
        peak_rss_mb=peak_mb,
    )


def _make_context(
    order: StageOrder, stage: Stage, scratch: Path, watch: Stopwatch, picture_queue: PictureQueue, plans: Path | None
) -> StageContext:
    return StageContext(
        job=restore_job(order.spec, order.figures),
        folder=scratch,
        watch=watch,
        picture_queue=picture_queue,
        number=stage.number,
        so_far=order.report,
        earlier_notes=order.notes,
        files=frozenset(name for name in order.inputs if not name.startswith(".")),
        picture=scratch / _PICTURE,
        picture_name=order.image_name,
        picture_called=order.image_name,
        limits=order.limits,
        plans=plans,
    )


def _fetch(order: StageOrder, stage: Stage, store: Store, scratch: Path) -> set[str]:
    """Fetch the files that the stage reads into the scratch folder; return their names there."""
    wanted = {name: order.inputs[name].sha256 for name in reads(order.stage, order.inputs)}
    if stage.picture:
        wanted[_PICTURE] = order.image_sha256
    for name, sha256 in wanted.items():
        called = order.image_name if name == _PICTURE else name
        try:
            store.fetch(sha256, scratch / name)
        except MissingObjectError:
            raise FailedError(Phrase("{name}: it is no longer in the artifact store", name=called)) from None
    return set(wanted)


def _put(scratch: Path, fetched: set[str], store: Store) -> dict[str, FileRef]:
    """Put every file that the stage has made into the store."""
    outputs = {}
    for path in sorted(scratch.iterdir()):
        if path.name not in fetched:
            stored = store.put_file(path)
            outputs[path.name] = FileRef(sha256=stored.sha256, bytes=stored.bytes)
    return outputs


def _require_space(context: StageContext) -> None:
    spec = cam_passes_of(context.spec)[context.number - 1]
    check_disk_space(context.folder, Phrase("the server's disk"), cam_stock_of(context.spec), (spec,))


@contextmanager
def _scratch_folder(scratch: Path) -> Iterator[None]:
    """Open a folder that is empty at first and gone in the end."""
    try:
        shutil.rmtree(scratch, ignore_errors=True)
        try:
            scratch.mkdir(parents=True)
        except OSError as error:
            error.filename = None
            raise FailedError(sentence_of_os_error(error, doing=Phrase("cannot make a folder to work in"))) from error
        yield
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def _hide_paths(scratch: Path) -> Iterator[None]:
    """Replace paths in errors, which should name files but not their folder; damage in the store is not the person's
    fault.
    """
    try:
        yield
    except SpecError:
        raise
    except ServiceError as error:
        if str(scratch) not in str(error):
            raise
        lines = [line.replace(f"{scratch}/", "").replace(str(scratch), "the working folder") for line in error.lines]
        raise FailedError(*lines) from error


class _Shares:
    """Converts progress within the parts of a stage to the share of the whole stage."""

    def __init__(self, stage: Stage, on_progress: Callable[[float], None]) -> None:
        self._parts = stage.parts
        self._on_progress = on_progress

    def start_stage(self, stage: str) -> None:
        self.report_share(stage, 0.0)

    def report_share(self, stage: str, share: float) -> None:
        before = 0.0
        for prefix, weight in self._parts:
            if stage.startswith(prefix):
                self._on_progress(before + weight * min(1.0, max(0.0, share)))
                return
            before += weight

    def end_stage(self, stage: str, seconds: float) -> None:
        self.report_share(stage, 1.0)
