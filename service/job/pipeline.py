"""The commands as sequences of stages: picture -> lens -> light -> programs -> pictures -> report.

The stages are those of the job server (`stages/plan.py`), all run in this process on one folder. Every command works
in a staging folder that takes the output's place only when all of it has succeeded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.job import files as job_files
from service.job.arrays import load_heightfield, load_target
from service.job.errors import in_the_services_words
from service.job.spec.model import JobSpec
from service.job.spec.resolve import cam_passes_of, cam_stock_of, with_plan
from service.job.stages.context import Workshop
from service.job.stages.lens import require_fit_in_stock, solid_block
from service.job.stages.order import merge_notes, merge_reports
from service.job.stages.picture_queue import PictureQueue
from service.job.stages.table import plan, stage_of
from service.progress import Reporter, Stopwatch

_LAST = "report"
_LENS = ("image", "irradiance", "passes", "map", "heightfield", "caustic")


@dataclass
class FolderJob:
    """A running command: the stages' common folder and desk, and what they have said so far."""

    spec: JobSpec
    folder: Path
    reporter: Reporter
    picture_queue: PictureQueue
    picture: Path = Path()
    report: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)
    desk: dict[str, Any] = field(default_factory=dict)

    def run(self, *stages: str) -> None:
        for name in stages:
            if name == _LAST:
                self.work(lambda shop: shop.picture_queue.finish())
            stage = stage_of(name)
            self.work(stage.load(), number=stage.number)
            self.spec = with_plan(self.spec, self.report)

    def work(self, function: Callable[[Workshop], None], *, number: int = 0) -> None:
        """Call a stage's function and join what it adds to the report and the notes."""
        shop = Workshop(
            spec=self.spec,
            folder=self.folder,
            watch=Stopwatch(self.reporter),
            picture_queue=self.picture_queue,
            number=number,
            so_far=self.report,
            earlier_notes=self.notes,
            picture=self.picture,
            picture_name=self.picture.name,
            desk=self.desk,
        )
        with in_the_services_words():
            function(shop)
        self.report = merge_reports((self.report, shop.report, {"timings_s": shop.watch.timings_s}))
        self.notes = merge_notes((self.notes, shop.notes))


def make(picture: Path, output: Path, spec: JobSpec, *, reporter: Reporter, force: bool = False) -> dict[str, Any]:
    """The whole chain. Returns what report.json holds."""
    job_files.require_usable_output(output, force=force)
    with _job(output, spec, reporter, picture=picture) as job:
        job.run(*_lens_stages(spec))
        job.work(_note_shortage)
        job.run(*(stage for stage in plan(job.spec) if stage not in _LENS))
    return job.report


def design(picture: Path, output: Path, spec: JobSpec, *, reporter: Reporter, force: bool = False) -> dict[str, Any]:
    """The lens and its light, no programs; programs of an earlier lens disappear with it."""
    job_files.require_usable_output(output, force=force)
    with _job(output, spec, reporter, picture=picture) as job:
        job.run(*_lens_stages(spec), _LAST)
    return job.report


def cam(output: Path, spec: JobSpec, *, reporter: Reporter) -> dict[str, Any]:
    """Programs for the lens in a job's folder."""
    kept = [*job_files.LENS_FILES, *job_files.LIGHT_FILES]
    with _job(output, spec, reporter, keep=kept) as job:
        lens = job.desk[job_files.HEIGHTFIELD] = load_heightfield(output / job_files.HEIGHTFIELD)
        job.work(lambda shop: require_fit_in_stock(shop, lens))
        if spec.to_be_planned:
            from service.job.stages.passes import passes_for_lens

            job.desk[job_files.MAP] = load_target(output / job_files.MAP)
            job.work(passes_for_lens)
            job.spec = with_plan(job.spec, job.report)
        job.work(_note_shortage)
        job.run(*(stage for stage in plan(job.spec) if stage not in (*_LENS, _LAST)))
        job.work(lambda shop: solid_block(shop, lens))  # the stock may have changed
        job.run(_LAST)
    return job.report


def caustic(output: Path, spec: JobSpec, *, reporter: Reporter) -> dict[str, Any]:
    """The light behind the lens in a job's folder, simulated again."""
    kept = [path.name for path in output.iterdir()] if output.is_dir() else []
    kept = [name for name in kept if name != job_files.REPORT and job_files.is_known(name)]
    with _job(output, spec, reporter, keep=kept) as job:
        job.desk[job_files.HEIGHTFIELD] = load_heightfield(output / job_files.HEIGHTFIELD)
        job.desk[job_files.MAP] = load_target(output / job_files.MAP)
        job.run("caustic", _LAST)
    return job.report


def _lens_stages(spec: JobSpec) -> tuple[str, ...]:
    return tuple(stage for stage in plan(spec) if stage in _LENS)


def _note_shortage(shop: Workshop) -> None:
    from service.job.planning.fit import shortage  # what it stands on is slow to import: a lens alone does without

    disk = f"the disk of {shop.folder.parent}"
    if sentence := shortage(shop.folder, disk, cam_stock_of(shop.spec), cam_passes_of(shop.spec)):
        shop.note("passes", sentence)


@contextmanager
def _job(
    output: Path, spec: JobSpec, reporter: Reporter, *, picture: Path = Path(), keep: Iterable[str] = ()
) -> Iterator[FolderJob]:
    """A job in a staging folder."""
    kept = tuple(keep)
    earlier = job_files.read_report(output) if kept else {}
    with job_files.stage_folder(output, keep=kept) as folder, PictureQueue() as picture_queue:
        job = FolderJob(spec=spec, folder=folder, reporter=reporter, picture_queue=picture_queue, picture=picture)
        if kept:
            _take_over(job, earlier, programs=any(job_files.is_program(name) for name in kept))
        yield job


def _take_over(job: FolderJob, earlier: dict[str, Any], *, programs: bool) -> None:
    """What an earlier report says of the parts that this command does not make anew."""
    keys = ("source", "image", "optics", "timings_s", *(("passes", "around", "as_milled") if programs else ()))
    job.report = {key: earlier[key] for key in keys if key in earlier}
    notes = earlier.get("warnings_by_part", {})
    job.notes = {part: list(notes.get(part, ())) for part in ("optics", *(("passes",) if programs else ()))}
