"""Checks existing programs, ours or edited by hand: against the rules of the mill, as before a start, and by simulating
the removal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from cam.around.check import AroundCheck
from cam.checking.check import PassCheck
from cam.errors import CamError
from cam.passes import PassSpec, Stock
from machines.errors import ProgramRefusedError
from machines.preflight.preflight import limits_of
from machines.profile import MachineProfile
from optics.heightfield import Heightfield
from service.errors import InputError, SpecError, printable
from service.job import files as job_files
from service.job.arrays import load_heightfield
from service.job.planning.witness import plan_witness
from service.job.spec.loading import load_stored_job, resolve_job
from service.job.spec.resolve import (
    ResolvedJob,
    cam_passes_of,
    cam_stock_of,
    cut_out_of,
    facing_task_of,
)
from service.job.stages import around
from service.job.stages.one_program import require_same_moves
from service.job.stages.programs import first_stock, simulate
from service.milling.preflight_child import examine
from service.progress import Reporter, Stopwatch
from service.wording import duration

T = TypeVar("T")
Task = tuple[Sequence[Path], PassSpec | around.AroundTask]
"""The programs of a pass, in the order in which they are run, and the pass, or what is milled around them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckSettings:
    """Settings from the command line for programs that come without a job: one value for all, or one for each."""

    radius_mm: tuple[float, ...]
    pitch_mm: tuple[float, ...]
    stock_to_leave_mm: tuple[float, ...]
    step_down_mm: tuple[float, ...]
    thickness_mm: float | None
    margin_mm: float | None
    machine: str | None

    @property
    def has_any(self) -> bool:
        return bool(self.radius_mm or self.pitch_mm or self.stock_to_leave_mm or self.step_down_mm)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The simulation's verdict on one program."""

    program: Path
    ok: bool
    faults: tuple[str, ...]
    gouge_um: float
    max_engagement_mm: float
    time_s: float

    def line(self) -> str:
        if not self.ok:
            return "\n".join(printable(f"error: {self.program}: {fault}") for fault in self.faults)
        return (
            f"{self.program}: no fault; gouge {self.gouge_um:.3f} um, deepest engagement "
            f"{self.max_engagement_mm:.3f} mm, {duration(self.time_s)}"
        )


def check_programs(
    programs: Sequence[Path], heightfield_path: Path, settings: CheckSettings, *, reporter: Reporter
) -> list[Verdict]:
    """Simulate programs one after the other on one block; a fault ends the run with that program."""
    _require_programs(programs)
    heightfield = load_heightfield(heightfield_path)
    folder = programs[0].parent
    if not settings.has_any and job_files.is_job_folder(folder):
        job = load_stored_job(folder)
        tasks, stock, machine = _read_job_tasks(programs, folder, job)
    else:
        job = None
        tasks, stock, machine = _make_option_tasks(programs, heightfield, settings)
    _require_programs([path for paths, _ in tasks for path in paths])  # the job's earlier ones, too
    watch, verdicts, limits = Stopwatch(reporter), [], limits_of(machine)
    stock_top = first_stock(stock) if job is None else around.raw_stock(job.spec)
    for paths, spec in tasks:
        path = paths[0]
        with watch.stage(f"pre-flight {path.name}") as reached:
            try:
                broken = [words for one in paths for words in examine(one, limits, reached).faults]
            except ProgramRefusedError as error:  # it is never sent to a mill
                verdicts.append(_make_unreadable_verdict(path, [str(error)]))
                break
        with watch.stage(f"check {path.name}") as reached:
            try:
                result: PassCheck | AroundCheck
                if isinstance(spec, PassSpec):
                    result = simulate(paths, spec, heightfield, stock, stock_top, machine, reached)
                else:
                    assert job is not None  # only a job has such tasks
                    result = around.simulate(paths, spec, job, stock_top)
            except CamError as error:  # text that must not be sent to a mill
                verdicts.append(_make_unreadable_verdict(path, broken or [str(error)]))
                break
        stock_top = result.stock_top
        verdicts.append(
            Verdict(
                program=path,
                ok=result.ok and not broken,
                faults=(*broken, *result.faults),
                gouge_um=result.gouge_um,
                max_engagement_mm=result.max_engagement_mm,
                time_s=result.time_s,
            )
        )
        if not verdicts[-1].ok:
            break
    return verdicts


def _require_programs(paths: Sequence[Path]) -> None:
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: there is no such program")


def _make_unreadable_verdict(path: Path, faults: Sequence[str]) -> Verdict:
    faults = [" ".join(fault.split()) for fault in faults]
    return Verdict(program=path, ok=False, faults=tuple(faults), gouge_um=0.0, max_engagement_mm=0.0, time_s=0.0)


def _read_job_tasks(
    programs: Sequence[Path], folder: Path, job: ResolvedJob
) -> tuple[list[Task], Stock, MachineProfile]:
    """Return passes by file name from the job's report and spec; passes before the last requested one are run, too, and
    all parts of a pass.
    """
    spec, report = job.spec, job_files.read_report(folder)
    rows = job_files.programs_in_order(report)
    files = [job_files.names_of_pass(row) for row in rows]
    of_file = {name: number for number, names in enumerate(files) for name in names}
    whole = str(job_files.table(report.get("one_program")).get("file"))
    if any(path.name == whole for path in programs):  # it holds the others, one after the other
        require_same_moves(folder / whole, [folder / name for names in files for name in names], job.machine)
        of_file[whole] = len(files) - 1
    for path in programs:
        if path.name not in of_file or path.parent.resolve() != folder.resolve():
            raise InputError(f"{path}: not a program of the job in {folder}; say --radius-mm and --pitch-mm")
    last = max(of_file[path.name] for path in programs)
    given = {path.name: path for path in programs}
    paths = [[given.get(name, folder / name) for name in names] for names in files[: last + 1]]
    marks = plan_witness(job).cut if job_files.WITNESS in report.get("around", {}) else None
    all_specs = (facing_task_of(spec), *cam_passes_of(spec), marks, cut_out_of(spec))
    specs = [one for one in all_specs if one is not None]
    tasks: list[Task] = list(zip(paths, specs, strict=False))
    return tasks, cam_stock_of(spec), job.machine


def _make_option_tasks(
    programs: Sequence[Path], heightfield: Heightfield, settings: CheckSettings
) -> tuple[list[Task], Stock, MachineProfile]:
    """Return passes from options, what is left out from the job spec's defaults."""
    count = len(programs)
    radii = _repeat_value("--radius-mm", settings.radius_mm, count)
    pitches = _repeat_value("--pitch-mm", settings.pitch_mm, count)
    leaves = _repeat_value("--stock-to-leave-mm", settings.stock_to_leave_mm or (0.0,), count)
    downs: Sequence[float | None] = _repeat_value("--step-down-mm", settings.step_down_mm or (None,), count)
    rows = [
        {"radius_mm": radius, "pitch_mm": pitch, "stock_to_leave_mm": leave}
        | ({} if down is None else {"step_down_mm": down})
        for radius, pitch, leave, down in zip(radii, pitches, leaves, downs, strict=True)
    ]
    stock = {"thickness_mm": settings.thickness_mm, "margin_mm": settings.margin_mm}
    try:
        job = resolve_job(
            base={
                "optics": {"width_mm": heightfield.width_mm, "height_mm": heightfield.height_mm},
                "stock": {key: value for key, value in stock.items() if value is not None},
                "machine": {"profile": settings.machine} if settings.machine else {},
                "passes": rows,
            }
        )
    except SpecError as error:
        raise InputError(*str(error).splitlines()) from None
    tasks: list[Task] = [([path], pass_) for path, pass_ in zip(programs, cam_passes_of(job.spec), strict=True)]
    return tasks, cam_stock_of(job.spec), job.machine


def _repeat_value(option: str, values: Sequence[T], count: int) -> list[T]:
    if len(values) == 1:
        return list(values) * count
    if not values:
        raise InputError(f"{option} is missing, and no report.json of a job lies beside the program to say it")
    if len(values) != count:
        allowed = f"1 or {count}" if count > 1 else "1"
        raise InputError(f"{option}: {len(values)} values for {count} program{'s' * (count > 1)}; allowed: {allowed}")
    return list(values)
