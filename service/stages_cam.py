"""Stages from the lens to checked programs: generate, write, read back and simulate; the stock left is carried over."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cam.check import PassCheck, check_program
from cam.duration import Kinematics
from cam.gcode import ProgramError, read_program
from cam.passes import PassSpec, Stock
from cam.posts.grbl import GRBL
from cam.posts.post import Post
from cam.program import generate_program
from cam.stock_grid import StockGrid
from machines.profiles import MachineProfile
from optics.heightfield import Heightfield
from service import figures_paths
from service.errors import FailedError, SpecError
from service.fitting import require_travel, shortage, unfit_ball
from service.job_files import TOOLPATH, program_name, read_chunks, write_program
from service.lens_facts import measure_lens
from service.passes import cam_passes_of, cam_stock_of, machine_of
from service.path_sample import PathSample
from service.spec import JobSpec
from service.workshop import Workshop

_POSTS: dict[str, Post] = {"grbl": GRBL, "grblhal": GRBL, "fluidnc": GRBL}
_CELLS_ACROSS = 2200  # of the whole-part removal grid: 0.05 mm cells on 110 mm


def require_post(spec: JobSpec) -> None:
    """Before any work: can programs be written in the language of the job's machine?"""
    machine = machine_of(spec)
    if machine.dialect not in _POSTS:
        allowed = ", ".join(f"'{name}'" for name in _POSTS)
        raise SpecError(
            [
                (
                    "machine.profile",
                    f"'{machine.name}' speaks {machine.dialect}, and no programs can be written in that yet; "
                    f"allowed: a machine of dialect {allowed} (see `causticmill machines`)",
                )
            ]
        )


def require_millable(shop: Workshop, heightfield: Heightfield) -> None:
    """Everything about balls, travel and disk that can be known before the first block."""
    passes, stock = cam_passes_of(shop.spec), cam_stock_of(shop.spec)
    with shop.watch.stage("fit"):
        require_travel(heightfield, stock, passes, machine_of(shop.spec))
        unfit = unfit_ball(measure_lens(heightfield), passes, shaped_for_mm=shop.spec.optics.min_radius_mm)
        for sentence in (unfit, shortage(shop.folder, stock, passes)):
            if sentence:
                shop.note("passes", sentence)
        if not passes[-1].finishes:
            left = passes[-1].stock_to_leave_mm
            shop.note("passes", f"the last pass leaves {left:g} mm of stock: no pass makes the optical surface")


def mill_stage(shop: Workshop, heightfield: Heightfield) -> None:
    """All programs, each written and then checked from its text; fills report `passes`.

    FailedError with the faults at the first program that does not pass; the staging folder, and the program with it,
    are then removed.
    """
    stock, machine = cam_stock_of(shop.spec), machine_of(shop.spec)
    stock_top = first_stock(stock)
    shop.report["passes"] = []
    for number, spec in enumerate(cam_passes_of(shop.spec), 1):
        path = shop.folder / program_name(number, spec.name, _POSTS[machine.dialect].suffix)
        row, stock_top = _one_pass(shop, number, spec, path, heightfield, stock, stock_top, machine)
        shop.report["passes"].append(row)


def toolpath_stage(shop: Workshop) -> None:
    """toolpath.png, drawn from the text of the programs."""
    stock = cam_stock_of(shop.spec)
    with shop.watch.stage("toolpath picture") as reached:
        samples = []
        for number, spec in enumerate(cam_passes_of(shop.spec), 1):
            path = shop.folder / shop.report["passes"][number - 1]["file"]
            samples.append(_sample(path, number, spec, stock))
            reached(number / (len(shop.spec.passes) + 1))
        picture = figures_paths.toolpath_png(
            samples, width_mm=stock.width_mm, height_mm=stock.height_mm, margin_mm=stock.margin_mm
        )
        shop.save(TOOLPATH, picture)


def first_stock(stock: Stock) -> StockGrid:
    """The uncut block at the resolution of the whole-part simulation."""
    longest_mm = max(stock.width_mm, stock.height_mm) + 2 * stock.margin_mm
    return StockGrid.block(stock, max(0.005, longest_mm / _CELLS_ACROSS))


def simulate(
    path: Path,
    spec: PassSpec,
    heightfield: Heightfield,
    stock: Stock,
    stock_top: StockGrid,
    machine: MachineProfile,
    on_progress: Callable[[float], None] | None = None,
) -> PassCheck:
    """Read a written program back and simulate what it removes from stock_top."""
    return check_program(
        read_chunks(path),
        heightfield=heightfield,
        spec=spec,
        stock=stock,
        stock_top=stock_top,
        kinematics=kinematics_of(machine),
        travel_mm=machine.travel_mm,
        safe_z_mm=machine.safe_z_mm,
        total_bytes=path.stat().st_size,
        on_progress=on_progress,
    )


def kinematics_of(machine: MachineProfile) -> Kinematics:
    return Kinematics(
        max_rate_mm_per_min=machine.max_rate_mm_per_min,
        acceleration_mm_per_s2=machine.acceleration_mm_per_s2,
        junction_deviation_mm=machine.junction_deviation_mm,
        planner_blocks=machine.planner_blocks + 1,  # slots: the one that is always free is not reported
        lines_per_s=machine.lines_per_s,
    )


def _one_pass(
    shop: Workshop,
    number: int,
    spec: PassSpec,
    path: Path,
    heightfield: Heightfield,
    stock: Stock,
    stock_top: StockGrid,
    machine: MachineProfile,
) -> tuple[dict[str, Any], StockGrid]:
    """Write and check one program; its row of report `passes` and the stock it leaves."""
    with shop.watch.stage(f"write pass {number} {spec.name}") as reached:
        chunks = generate_program(
            heightfield,
            spec,
            stock,
            stock_top=stock_top,
            post=_POSTS[machine.dialect],
            safe_z_mm=machine.safe_z_mm,
            on_progress=reached,
        )
        written = write_program(path, chunks)
    with shop.watch.stage(f"check pass {number} {spec.name}") as reached:
        try:
            verdict = simulate(path, spec, heightfield, stock, stock_top, machine, reached)
        except ProgramError as error:
            raise FailedError(f"{path.name}: {error}") from error
    if not verdict.ok:
        raise FailedError(*(f"{path.name}: {fault}" for fault in verdict.faults))
    for sentence in verdict.notes if spec.finishes else ():
        shop.note("passes", f"{path.name}: {sentence}")
    row = {
        "file": written.file,
        "sha256": written.sha256,
        **verdict.as_report(),
        "lines": written.lines,
        "bytes": written.bytes,
        "settings": shop.spec.passes[number - 1].model_dump(),
    }
    return row, verdict.stock_top


def _sample(path: Path, number: int, spec: PassSpec, stock: Stock) -> PathSample:
    sample = PathSample(
        label=f"pass {number} {spec.name}",
        pitch_mm=spec.pitch_mm,
        radius_mm=spec.radius_mm,
        width_mm=stock.width_mm,
        height_mm=stock.height_mm,
    )
    for batch in read_program(read_chunks(path)):
        sample.add(batch.start_mm, batch.end_mm, batch.is_rapid)
    return sample
