"""The commands as sequences of stages: picture -> lens -> light -> programs -> pictures -> report.

The stages are those of the job server (`stages/table.py`), all run in this process on one folder. Every command works
in a staging folder that takes the output's place only when all of it has succeeded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from phrases.phrase import Phrase
from service.errors import DiskError, ServiceError, printable
from service.job import files as job_files
from service.job.arrays import load_heightfield, load_target
from service.job.errors import LensKeptError, translate_errors
from service.job.spec.model import JobSpec
from service.job.spec.resolve import ResolvedJob, cam_passes_of, cam_stock_of
from service.job.stages.context import PictureQueue, StageContext
from service.job.stages.lens import require_fit_in_stock, write_solid_block
from service.job.stages.preload import DRAWING
from service.job.stages.table import JobSoFar, is_of_programs, plan, reads, stage_of
from service.progress import Reporter, Stopwatch

_LAST = "report"
_LENS = ("image", "irradiance", "passes", "map", "heightfield", "caustic")


@dataclass
class FolderJob:
    """A running command: the stages' common folder and desk, and their results so far."""

    so_far: JobSoFar
    folder: Path
    reporter: Reporter
    picture_queue: PictureQueue
    picture: Path = Path()
    desk: dict[str, Any] = field(default_factory=dict)

    @property
    def spec(self) -> JobSpec:
        return self.so_far.job.spec

    def run(self, name: str) -> None:
        if name == _LAST:
            self.work(lambda context: context.picture_queue.finish())
        stage = stage_of(name)
        self.work(stage.load(), number=stage.number)
        self._clear_desk(name)

    def _clear_desk(self, done: str) -> None:
        """Free the memory of intermediate results that no later stage reads."""
        stages = plan(self.spec)
        later = stages[stages.index(done) + 1 :]
        wanted = {name for stage in later for name in reads(stage, self.desk)}
        for name in [one for one in self.desk if one.startswith(".") and one not in wanted]:
            del self.desk[name]

    def keep_lens(self, lens: JobSoFar, error: LensKeptError) -> None:
        """Return the job to its state with the lens only: no program is left, not even one that passed its check,
        because the mill's rules have not been applied to all of them.
        """
        self.work(lambda context: context.picture_queue.finish())
        for path in self.folder.iterdir():
            if path.name not in (*job_files.LENS_FILES, *job_files.LIGHT_FILES):
                path.unlink()
        self.so_far = lens
        self.work(lambda context: context.note("passes", error.reason))
        self.run(_LAST)

    def work(self, function: Callable[[StageContext], None], *, number: int = 0) -> None:
        """Call a stage's function and add its results to the report and the notes."""
        context = StageContext(
            job=self.so_far.job,
            folder=self.folder,
            watch=Stopwatch(self.reporter),
            picture_queue=self.picture_queue,
            number=number,
            so_far=self.so_far.report,
            earlier_notes=self.so_far.notes,
            picture=self.picture,
            picture_name=printable(self.picture.name),
            desk=self.desk,
        )
        with translate_errors():
            self.picture_queue.raise_failures()  # report a full disk now, not after all later stages
            function(context)
        self.so_far.add({**context.finish_report(), "timings_s": context.watch.timings_s}, context.notes)


def make(picture: Path, output: Path, job: ResolvedJob, *, reporter: Reporter, force: bool = False) -> dict[str, Any]:
    """Run the whole chain; return what report.json holds.

    Where a program is refused, a new folder keeps the lens as `design` leaves it, and LensKeptError is raised; a folder
    with an earlier job stays as it is.
    """
    job_files.require_usable_output(output, force=force)
    is_new = not (output / job_files.REPORT).exists()
    kept: LensKeptError | None = None
    with _job(output, job, reporter, picture=picture) as folder_job:
        lens = folder_job.so_far
        for stage in folder_job.so_far.stages():
            try:
                folder_job.run(stage)
            except DiskError:
                raise
            except ServiceError as error:
                if not (is_new and is_of_programs(stage)):
                    raise
                kept = LensKeptError(error, stage, output)
                folder_job.keep_lens(lens, kept)
                break
            if stage == _LENS[-1]:
                lens = replace(folder_job.so_far)
                folder_job.work(_warn_of_shortage)
    if kept is not None:
        raise kept
    return folder_job.so_far.report


def design(picture: Path, output: Path, job: ResolvedJob, *, reporter: Reporter, force: bool = False) -> dict[str, Any]:
    """Make the lens and its light, no programs; programs of an earlier lens disappear with it."""
    job_files.require_usable_output(output, force=force)
    with _job(output, job, reporter, picture=picture) as folder_job:
        for stage in folder_job.so_far.stages():
            if stage in (*_LENS, _LAST):
                folder_job.run(stage)
    return folder_job.so_far.report


def make_programs(output: Path, job: ResolvedJob, *, reporter: Reporter) -> dict[str, Any]:
    """Write programs for the lens in a job's folder."""
    kept = [*job_files.LENS_FILES, *job_files.LIGHT_FILES]
    with _job(output, job, reporter, keep=kept) as folder_job:
        lens = folder_job.desk[job_files.HEIGHTFIELD] = load_heightfield(output / job_files.HEIGHTFIELD)
        folder_job.work(lambda context: require_fit_in_stock(context, lens))
        if job.spec.to_be_planned:
            from service.job.stages.kept_plans import plan_passes_for_lens

            folder_job.desk[job_files.MAP] = load_target(output / job_files.MAP)
            folder_job.work(plan_passes_for_lens)
        folder_job.work(_warn_of_shortage)
        for stage in folder_job.so_far.stages():
            if stage == _LAST:
                folder_job.work(lambda context: write_solid_block(context, lens))  # the stock may have changed
            if stage not in _LENS:
                folder_job.run(stage)
    return folder_job.so_far.report


def simulate_caustic(output: Path, job: ResolvedJob, *, reporter: Reporter) -> dict[str, Any]:
    """Simulate the light behind the lens in a job's folder again."""
    kept = [path.name for path in output.iterdir()] if output.is_dir() else []
    kept = [name for name in kept if name != job_files.REPORT and job_files.is_known(name)]
    with _job(output, job, reporter, keep=kept) as folder_job:
        folder_job.desk[job_files.HEIGHTFIELD] = load_heightfield(output / job_files.HEIGHTFIELD)
        folder_job.desk[job_files.MAP] = load_target(output / job_files.MAP)
        for stage in ("caustic", _LAST):
            folder_job.run(stage)
    return folder_job.so_far.report


def _warn_of_shortage(context: StageContext) -> None:
    from service.job.planning.fit import (
        check_disk_space,  # its dependencies are slow to import, and a lens alone does not need them
    )

    disk = Phrase("the disk of {folder}", folder=context.folder.parent)
    if sentence := check_disk_space(context.folder, disk, cam_stock_of(context.spec), cam_passes_of(context.spec)):
        context.note("passes", sentence)


@contextmanager
def _job(
    output: Path, job: ResolvedJob, reporter: Reporter, *, picture: Path = Path(), keep: Iterable[str] = ()
) -> Iterator[FolderJob]:
    """Open a job in a staging folder."""
    kept = tuple(keep)
    earlier = job_files.read_report(output) if kept else {}
    with job_files.stage_folder(output, keep=kept) as folder, PictureQueue() as picture_queue:
        picture_queue.import_first(DRAWING)
        so_far = JobSoFar(job)
        if kept:
            _take_over(so_far, earlier, programs=any(job_files.is_program(name) for name in kept))
        yield FolderJob(so_far, folder, reporter, picture_queue, picture)


def _take_over(so_far: JobSoFar, earlier: dict[str, Any], *, programs: bool) -> None:
    """Copy the parts of an earlier report that this command does not make again."""
    keys = (
        "source",
        "image",
        "optics",
        "timings_s",
        "phrases",
        *(("passes", "around", "witness", "as_milled") if programs else ()),
    )
    so_far.report = {key: earlier[key] for key in keys if key in earlier}
    notes = earlier.get("warnings_by_part", {})
    so_far.notes = {part: list(notes.get(part, ())) for part in ("optics", *(("passes",) if programs else ()))}
