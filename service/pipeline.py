"""The commands as sequences of stages: picture -> lens -> light -> programs -> pictures -> report.

Every command works in a staging folder that takes the output's place only when all of it has succeeded.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cam.errors import CamError, CutterTooLargeError, PassValueError, SafeHeightError, StockTooThinError
from optics.errors import OpticsError
from optics.heightfield import Heightfield
from service import job_files
from service.errors import FailedError, InputError
from service.progress import Reporter, Stopwatch
from service.report_stage import report_stage
from service.solid import ReliefTooDeep, SolidError
from service.spec import JobSpec
from service.stages_cam import mill_stage, require_millable, require_post, toolpath_stage
from service.stages_optics import caustic_stage, design_stage, read_target, require_fit_in_stock, solid_stage
from service.workshop import Part, Workshop, load_heightfield, load_target

_INPUT_ERRORS = (
    OpticsError, ReliefTooDeep, CutterTooLargeError, PassValueError, SafeHeightError, StockTooThinError,
)  # fmt: skip


def make(picture: Path, output: Path, spec: JobSpec, *, reporter: Reporter, force: bool = False) -> dict[str, Any]:
    """The whole chain. Returns what report.json holds."""
    require_post(spec)
    job_files.require_usable_output(output, force=force)
    with _workshop(output, spec, reporter) as shop:
        heightfield = _lens(shop, picture)
        require_millable(shop, heightfield)
        mill_stage(shop, heightfield)
        toolpath_stage(shop)
        report_stage(shop)
    return shop.report


def design(picture: Path, output: Path, spec: JobSpec, *, reporter: Reporter, force: bool = False) -> dict[str, Any]:
    """The lens and its light, no programs; programs of an earlier lens disappear with it."""
    job_files.require_usable_output(output, force=force)
    with _workshop(output, spec, reporter) as shop:
        _lens(shop, picture)
        report_stage(shop)
    return shop.report


def cam(output: Path, spec: JobSpec, *, reporter: Reporter) -> dict[str, Any]:
    """Programs for the lens in a job's folder."""
    require_post(spec)
    kept = [*job_files.LENS_FILES, *job_files.LIGHT_FILES]
    with _workshop(output, spec, reporter, keep=kept) as shop:
        heightfield = load_heightfield(output / job_files.HEIGHTFIELD)
        require_fit_in_stock(shop, heightfield)
        require_millable(shop, heightfield)
        mill_stage(shop, heightfield)
        toolpath_stage(shop)
        solid_stage(shop, heightfield)  # the stock may have changed
        report_stage(shop)
    return shop.report


def caustic(output: Path, spec: JobSpec, *, reporter: Reporter) -> dict[str, Any]:
    """The light behind the lens in a job's folder, simulated again."""
    kept = [path.name for path in output.iterdir()] if output.is_dir() else []
    kept = [name for name in kept if name != job_files.REPORT and job_files.is_known(name)]
    with _workshop(output, spec, reporter, keep=kept) as shop:
        heightfield = load_heightfield(output / job_files.HEIGHTFIELD)
        caustic_stage(shop, heightfield, load_target(output))
        report_stage(shop)
    return shop.report


def _lens(shop: Workshop, picture: Path) -> Heightfield:
    target = read_target(shop, picture)
    heightfield = design_stage(shop, target).heightfield
    require_fit_in_stock(shop, heightfield)
    caustic_stage(shop, heightfield, target)
    solid_stage(shop, heightfield)
    return heightfield


@contextmanager
def _workshop(output: Path, spec: JobSpec, reporter: Reporter, *, keep: Iterable[str] = ()) -> Iterator[Workshop]:
    """A staging folder with the spec in it; the packages' own errors come out as the service's."""
    kept = tuple(keep)
    earlier = job_files.read_report(output) if kept else {}
    with job_files.staging_folder(output, keep=kept) as folder:
        shop = Workshop(spec=spec, folder=folder, watch=Stopwatch(reporter))
        if kept:
            _take_over(shop, earlier, programs=any(job_files.is_program(name) for name in kept))
        job_files.write_json(folder / job_files.SPEC, spec.plain())
        try:
            yield shop
        except (OpticsError, CamError, SolidError) as error:
            kind = InputError if isinstance(error, _INPUT_ERRORS) else FailedError
            raise kind(" ".join(str(error).split())) from error


def _take_over(shop: Workshop, earlier: dict[str, Any], *, programs: bool) -> None:
    """What an earlier report says of the parts that this command does not make anew."""
    for key in ("source", "optics", *(("passes",) if programs else ())):
        if key in earlier:
            shop.report[key] = earlier[key]
    shop.watch.timings_s.update(earlier.get("timings_s", {}))
    notes = earlier.get("warnings_by_part", {})
    parts: tuple[Part, ...] = ("optics", "passes") if programs else ("optics",)
    for part in parts:
        for sentence in notes.get(part, []):
            shop.note(part, sentence)
