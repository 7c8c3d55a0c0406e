"""The picture as milled, 100 x 100 mm: the stage that a job runs, on programs as they are written.

Each case runs in a fresh process of its own (`python -m tests.benchmarks.milled FOLDER`), compiled kernels at hand as
an installed program has them: it reads the program, works out the surface, shines light through it, asks what costs
most and draws. Its memory is that process's. Then the surface against brute force on windows (`milled_windows`).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from cam.posts.dialects import GRBL
from cam.surface.stock_grid import StockGrid
from optics.design import design_lens
from optics.heightfield import Heightfield
from service.job.arrays import heightfield_bytes, target_bytes
from service.job.files import HEIGHTFIELD, MAP, SPEC
from service.job.spec.lens_task import branch_of, lens_settings
from service.job.spec.loading import resolve_spec, validate_spec
from service.job.spec.model import JobSpec
from service.job.spec.resolve import cam_passes_of, cam_stock_of, look_up
from service.job.stages.as_milled import run_as_milled
from service.job.stages.context import PictureQueue, StageContext, peak_rss_mb
from service.progress import QuietReporter, Stopwatch
from tests.benchmarks import milled_windows
from tests.benchmarks.pictures import target
from tests.benchmarks.timing import Figure
from tests.cam.programs import generate_program

FINISH = "passes.2."
STILL = ("machine.step_mm=0.000001", "machine.z_noise_mm=0")
MILL = ("machine.step_mm=0.002", "machine.z_noise_mm=0.0005")
PROGRAM = "finish.nc"
SKIN_MM = 0.03  # what the pass before leaves


class Case(NamedTuple):
    name: str
    settings: tuple[str, ...]


CASES = (
    Case("rows, pitch 0.02", STILL),
    Case("rows, pitch 0.005", (*STILL, f"{FINISH}pitch_mm=0.005")),
    Case("rows, pitch 0.02, step 2 um, noise 0.5 um", MILL),
    Case("contour, pitch 0.02, step 2 um, noise 0.5 um", (*MILL, f"{FINISH}strategy=contour")),
)


def figures(pixels: int = 512, side_mm: float = 100.0) -> Iterator[Figure]:
    whole = (f"image.pixels={pixels}", *(f"optics.{side}_mm={side_mm:g}" for side in ("width", "height", "throw")))
    goal = target("camera", pixels)
    spec = resolve_spec(preset="paper", overrides=whole)
    lens = design_lens(goal, lens_settings(spec, branch=branch_of(spec, goal))).heightfield
    _compile()
    for case in CASES:
        with tempfile.TemporaryDirectory() as path:
            written_s = _prepare(
                Path(path), resolve_spec(preset="paper", overrides=(*whole, *case.settings)), lens, goal
            )
            size_mb = (Path(path) / PROGRAM).stat().st_size / 1e6
            yield from _as_figures(case.name, _run_apart(Path(path)), f"{size_mb:.0f} MB, written in {written_s:.0f} s")
    yield from milled_windows.figures(lens)


def _compile() -> None:
    """On a small lens, in a process of its own."""
    overrides = ("image.pixels=32", *(f"optics.{side}_mm=8" for side in ("width", "height")), "optics.throw_mm=40")
    spec, goal = resolve_spec(preset="paper", overrides=overrides), target("camera", 32)
    lens = design_lens(goal, lens_settings(spec, branch=branch_of(spec, goal))).heightfield
    with tempfile.TemporaryDirectory() as path:
        _prepare(Path(path), spec, lens, goal)
        _run_apart(Path(path))


def _prepare(folder: Path, spec: JobSpec, lens: Heightfield, goal: Any) -> float:
    """What the stage reads, in the folder; seconds that the program took."""
    (folder / HEIGHTFIELD).write_bytes(heightfield_bytes(lens))
    (folder / MAP).write_bytes(target_bytes(goal))
    (folder / SPEC).write_text(json.dumps(spec.plain()))
    stock, started = cam_stock_of(spec), time.perf_counter()
    block = StockGrid.block(stock, 0.25)
    skin = lens.spline().extend(12.0).heights_mm(block.x_mm[None, :], block.y_mm[:, None]) + SKIN_MM
    top = StockGrid(x0_mm=block.x0_mm, y0_mm=block.y0_mm, cell_mm=block.cell_mm, top_mm=skin.clip(max=0.0))
    with (folder / PROGRAM).open("wb") as file:
        for piece in generate_program(lens, cam_passes_of(spec)[-1], stock, stock_top=top, post=GRBL):
            file.write(piece)
    return time.perf_counter() - started


def _run_apart(folder: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.benchmarks.milled", str(folder)]
    found: dict[str, Any] = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
    return found


def run(folder: Path) -> dict[str, Any]:
    """The stage on what is in the folder: seconds, memory, and what it says of the picture."""
    job, watch = look_up(validate_spec(json.loads((folder / SPEC).read_text()))), Stopwatch(QuietReporter())
    rows = [{"file": PROGRAM} for _ in job.spec.passes]
    started, cpu = time.perf_counter(), time.process_time()
    with PictureQueue() as picture_queue:
        context = StageContext(
            job=job, folder=folder, watch=watch, picture_queue=picture_queue, so_far={"passes": rows}
        )
        run_as_milled(context)
        picture_queue.finish()
    return {
        "wall_s": time.perf_counter() - started,
        "cpu_s": time.process_time() - cpu,
        "peak_gb": peak_rss_mb() / 1e3,
        "parts_s": watch.timings_s,
        "report": context.report["as_milled"],
    }


def _as_figures(name: str, found: dict[str, Any], program: str) -> Iterator[Figure]:
    said, spent = found["report"], found["parts_s"]
    parts = ", ".join(f"{part.partition(': ')[2]} {seconds:.0f}" for part, seconds in spent.items())
    note = f"CPU {found['cpu_s']:.0f} s, peak {found['peak_gb']:.2f} GB; {parts}; {program}; asked: 120"
    yield Figure(f"as milled, {name}", found["wall_s"], "s", note)
    words = f"SSIM {said['ssim']:.3f}, slopes {said['slope_rms_mrad']:.1f} mrad, blur {said['blur_px']:.2f} px"
    yield Figure("  the picture", said["psnr_db"], "dB", words)


if __name__ == "__main__":
    print(json.dumps(run(Path(sys.argv[1]))))
