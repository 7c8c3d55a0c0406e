"""Stages from the lens to checked programs: generate, write, read back and simulate; the stock left is carried over."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cam.check import PassCheck, check_program
from cam.duration import Kinematics
from cam.gcode import ProgramError
from cam.passes import PassSpec, Stock
from cam.posts.grbl import GRBL
from cam.posts.post import Post
from cam.program import generate_program
from cam.stock_grid import StockGrid
from machines.profiles import MachineProfile
from optics.heightfield import Heightfield
from service.errors import FailedError, SpecError
from service.fitting import require_travel, unfit_ball
from service.job_files import HEIGHTFIELD, WrittenProgram, program_name, read_chunks, write_program
from service.lens_facts import measure_lens
from service.passes import cam_passes_of, cam_stock_of, machine_of
from service.spec import JobSpec
from service.stages import arrays
from service.stages.workshop import Workshop

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


def one_pass(shop: Workshop) -> None:
    """One program, written and then checked from its text; its row of report `passes`, and the stock it leaves.

    FailedError with the faults where it does not pass; the folder, and the program with it, are then removed.
    """
    heightfield = shop.receive(HEIGHTFIELD, arrays.load_heightfield)
    spec, stock = cam_passes_of(shop.spec)[shop.number - 1], cam_stock_of(shop.spec)
    if shop.number == 1:
        require_post(shop.spec)
        require_millable(shop, heightfield)
        stock_top = first_stock(stock)
    else:
        stock_top = shop.receive(stock_name(shop.number - 1), arrays.load_stock)
    written = _write(shop, spec, heightfield, stock_top)
    verdict = _check(shop, written.file, spec, heightfield, stock_top)
    for sentence in verdict.notes if spec.finishes else ():
        shop.note("passes", f"{written.file}: {sentence}")
    row = {
        "file": written.file,
        "sha256": written.sha256,
        **verdict.as_report(),
        "lines": written.lines,
        "bytes": written.bytes,
        "settings": shop.spec.passes[shop.number - 1].model_dump(),
    }
    shop.report["passes"] = [row]
    if shop.number < len(shop.spec.passes):
        shop.hand_over(stock_name(shop.number), verdict.stock_top, arrays.stock_bytes)


def stock_name(number: int) -> str:
    """The file that holds what pass `number` has left."""
    return f".stock-{number}.npz"


def require_millable(shop: Workshop, heightfield: Heightfield) -> None:
    """Everything about the balls of all passes and the travel that can be known before the first block."""
    passes, stock = cam_passes_of(shop.spec), cam_stock_of(shop.spec)
    with shop.watch.stage("fit"):
        require_travel(heightfield, stock, passes, machine_of(shop.spec))
        unfit = unfit_ball(measure_lens(heightfield), passes, shaped_for_mm=shop.spec.lens_radius_mm)
        if unfit:
            shop.note("passes", unfit)
        if not passes[-1].finishes:
            left = passes[-1].stock_to_leave_mm
            shop.note("passes", f"the last pass leaves {left:g} mm of stock: no pass makes the optical surface")


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


def _write(shop: Workshop, spec: PassSpec, heightfield: Heightfield, stock_top: StockGrid) -> WrittenProgram:
    machine = machine_of(shop.spec)
    post = _POSTS[machine.dialect]
    with shop.watch.stage(f"write pass {shop.number} {spec.name}") as reached:
        chunks = generate_program(
            heightfield,
            spec,
            cam_stock_of(shop.spec),
            stock_top=stock_top,
            post=post,
            safe_z_mm=machine.safe_z_mm,
            on_progress=reached,
        )
        return write_program(shop.folder / program_name(shop.number, spec.name, post.suffix), chunks)


def _check(shop: Workshop, file: str, spec: PassSpec, heightfield: Heightfield, stock_top: StockGrid) -> PassCheck:
    stock, machine = cam_stock_of(shop.spec), machine_of(shop.spec)
    with shop.watch.stage(f"check pass {shop.number} {spec.name}") as reached:
        try:
            verdict = simulate(shop.folder / file, spec, heightfield, stock, stock_top, machine, reached)
        except ProgramError as error:
            raise FailedError(f"{file}: {error}") from error
    if not verdict.ok:
        raise FailedError(*(f"{file}: {fault}" for fault in verdict.faults))
    return verdict
