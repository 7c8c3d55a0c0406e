"""Chip per tooth of every program: bundled profiles, pictures, sizes, `recommended` and `paper`, from their text.

Programs are made as a job makes them, but of lenses with 128 pixels, into a coarse block, and exact rows of a finish
are thinned to some hundred: their feed is the same in every row. The chip is feed over (speed x flutes), as cutter
makers tabulate it, of the feed that the mill reaches, over the time in which the cutter takes stock off
(`cam.checking.chips`).

    python -m tests.trials.chips [WORD]...        # only rows with these words: a profile, a picture, "30", "paper"
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

from cam.checking.chips import Chips, ChipTime
from cam.checking.flat_removal import removal_of
from cam.duration import DurationModel, Kinematics
from cam.passes import PassSpec, Stock
from cam.posts.dialects import POSTS
from cam.program import generate_parts
from cam.reading.gcode import LANGUAGES, read_parts
from cam.surface.stock_grid import StockGrid
from machines.profile import MachineProfile, load_profile, profile_names
from optics.design import design_lens
from optics.heightfield import Heightfield
from service.errors import ServiceError
from service.job.picture.reading import read_picture
from service.job.planning.planner import plan_for_picture
from service.job.planning.preparation import aim_at_picture
from service.job.spec.lens_task import branch_of, lens_settings
from service.job.spec.loading import resolve_job
from service.job.spec.resolve import ResolvedJob, cam_passes_of, cam_stock_of, setup_of, with_plan
from service.job.stages.lens import aim_of
from service.job.stages.programs import CHIPS_WITHIN
from tests.benchmarks.timing import Figure

PIXELS = 128
PICTURES = ("camera", "astronaut", "logo")
SIZES_MM = (30, 60, 100)
PRESETS = ("recommended", "paper")
MOST_ROWS = 160  # of a finish
CELLS_ACROSS = 500
_EXAMPLES = Path(__file__).parents[2] / "examples"


def figures(words: tuple[str, ...] = ()) -> Iterator[Figure]:
    for size_mm, picture, preset, machine in product(SIZES_MM, PICTURES, PRESETS, profile_names(())):
        name = f"{machine} {picture} {size_mm} mm {preset}"
        if all(word in name.split() for word in words):
            try:
                yield from _measure(name, machine, picture, size_mm, preset)
            except ServiceError as error:
                yield Figure(name, 0.0, "%", f"refused: {error}")


def _measure(name: str, machine: str, picture: str, size_mm: float, preset: str) -> Iterator[Figure]:
    sizes = (f"optics.width_mm={size_mm}", f"optics.height_mm={size_mm}", f"optics.throw_mm={max(100, size_mm)}")
    top_z_mm = load_profile(machine).top_z_mm  # stated as an owner does; where it is a guess, a job asks for it
    top = () if top_z_mm is None else (f"machine.top_z_mm={top_z_mm}",)
    given = (*sizes, *top, f"image.pixels={PIXELS}", f"machine.profile='{machine}'")
    job = resolve_job(file=None, preset=preset, overrides=given)
    linear = read_picture(_EXAMPLES / f"{picture}.png", job.spec.image, rows=PIXELS, aspect=1.0).linear
    target = aim_at_picture(job.spec, linear).target
    if job.spec.to_be_planned:
        job = job.with_spec(with_plan(job.spec, {"plan": plan_for_picture(job, target).settings()}))
    lens = design_lens(
        aim_of(job.spec, target), lens_settings(job.spec, branch=branch_of(job.spec, target))
    ).heightfield
    for spec, chips in measure_job(job, lens):
        warned = "" if chips.share >= CHIPS_WITHIN else "the job warns: "
        yield Figure(f"{name} {spec.name}", 100 * chips.share, "%", warned + describe(spec, chips))


def describe(spec: PassSpec, chips: ChipTime) -> str:
    (below_s, _, above_s), (least_mm, most_mm) = chips.seconds, spec.chip_mm
    chip_mm = spec.feed_mm_per_min / spec.spindle_rpm / spec.flutes
    return (
        f"R{spec.radius_mm:g} Z{spec.flutes} F{spec.feed_mm_per_min:g} S{spec.spindle_rpm:g}: {chip_mm:.3f} mm, band "
        f"{least_mm:g} to {most_mm:g}; below {below_s:.0f} s, above {above_s:.0f} s of {sum(chips.seconds):.0f} s"
    )


def measure_job(job: ResolvedJob, lens: Heightfield) -> Iterator[tuple[PassSpec, ChipTime]]:
    """Yield each pass with the chips of its program."""
    stock, machine = cam_stock_of(job.spec), job.machine
    longest_mm = max(stock.width_mm, stock.height_mm) + 2 * stock.margin_mm
    top = StockGrid.block(stock, longest_mm / CELLS_ACROSS)
    for number, spec in enumerate(cam_passes_of(job.spec), 1):
        spec = replace(spec, max_rate_mm_per_min=machine.max_rate_mm_per_min)
        chips, top = measure_pass(number, spec, stock, machine, lens, top)
        yield spec, chips


def measure_pass(
    number: int, spec: PassSpec, stock: Stock, machine: MachineProfile, lens: Heightfield, top: StockGrid
) -> tuple[ChipTime, StockGrid]:
    least_mm = max(stock.width_mm, stock.height_mm) / MOST_ROWS
    thinned = replace(spec, pitch_mm=min(max(spec.pitch_mm, least_mm), spec.radius_mm)) if spec.finishes else spec
    thinned = replace(thinned, strategy="raster")
    parts = generate_parts(
        lens, thinned, stock, stock_top=top, post=POSTS[machine.dialect], safe_z_mm=machine.safe_z_mm,
        number=number, setup=setup_of(machine, tool=number),
    )  # fmt: skip
    duration, chips = DurationModel(Kinematics.of(machine)), Chips(spec)
    grid = removal_of(spec.shape, top, radius_mm=spec.radius_mm)
    for batch in read_parts(parts, LANGUAGES[machine.dialect]):
        chips.add(batch, grid.cut(batch), duration.add_batch(batch))
    found = chips.finish(duration.list_waiting_s())
    return found, grid.stock()


if __name__ == "__main__":
    for figure in figures(tuple(sys.argv[1:])):
        print(f"{figure.name:50} {figure.value:6.1f} {figure.unit}  {figure.note}", flush=True)
