"""The contour finish of three lenses, 100 x 100 mm at pitch 0.02: what issue 6 asks, measured on the written file.

Each program is made in a fresh process of its own (`python -m tests.benchmarks.contour LENS FOLDER`), compiled kernels
at hand as an installed program has them; then it is read back, cut in the computer and scanned everywhere.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from cam.checking.check import PassCheck, check_program
from cam.duration import Kinematics
from cam.passes import PAPER_PASSES, PassSpec, Stock
from cam.planning.shop import pitches_mm
from cam.posts.dialects import GRBL
from cam.surface.stock_grid import StockGrid
from machines.profile import load_profile
from optics.design import design_lens
from optics.heightfield import Heightfield
from service.job.arrays import heightfield_bytes, load_heightfield
from service.job.files import read_chunks
from service.job.spec.tools import load_tools
from tests.benchmarks.pictures import PAPER_SETTING, bumps, target
from tests.benchmarks.timing import Figure
from tests.cam.programs import generate_program

LENSES = ("camera", "astronaut", "logo")
FINISH = replace(PAPER_PASSES[2], strategy="contour")
WINDOW = 0.3  # of a lens along each side
SKIN_MM = 0.03  # what the pass before leaves, along Z
FEED_MM_PER_S = FINISH.feed_mm_per_min / 60


def lens_of(name: str, pixels: int = 512, *, radius_mm: float = FINISH.radius_mm) -> Heightfield:
    settings = replace(PAPER_SETTING, corrections=2, min_radius_mm=radius_mm)
    return design_lens(target(name, pixels), settings).heightfield


def block_of(lens: Heightfield) -> Stock:
    return Stock(width_mm=lens.width_mm, height_mm=lens.height_mm, thickness_mm=60.0, margin_mm=5.0)


def skin_over(lens: Heightfield, cell_mm: float) -> StockGrid:
    """What the pass before has left."""
    block = StockGrid.block(block_of(lens), cell_mm)
    top = lens.spline().extend(12.0).heights_mm(block.x_mm[None, :], block.y_mm[:, None]) + SKIN_MM
    return replace(block, top_mm=np.minimum(top, 0.0))


def make(folder: Path) -> dict[str, float]:
    """The program of the lens in the folder, written there; seconds and GB of this process."""
    lens = load_heightfield(folder / "lens.npz")
    started = time.perf_counter()
    with (folder / "finish.nc").open("wb") as file:
        for piece in generate_program(lens, FINISH, block_of(lens), stock_top=skin_over(lens, 0.25), post=GRBL):
            file.write(piece)
    wall_s, peak = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"wall_s": wall_s, "cpu_s": time.process_time(), "peak_gb": peak / 1e6}


def judge(chunks: Iterable[bytes], lens: Heightfield, spec: PassSpec, cell_mm: float = 0.05) -> PassCheck:
    machine = load_profile("grbl")
    return check_program(
        chunks,
        heightfield=lens,
        spec=spec,
        stock=block_of(lens),
        stock_top=skin_over(lens, cell_mm),
        kinematics=Kinematics.of(machine),
        travel_mm=machine.travel_mm,
        safe_z_mm=machine.safe_z_mm,
    )


def made_apart(folder: Path, lens: Heightfield) -> dict[str, float]:
    """`make` in a process of its own."""
    (folder / "lens.npz").write_bytes(heightfield_bytes(lens))
    command = [sys.executable, "-m", "tests.benchmarks.contour", str(folder)]
    found: dict[str, float] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return found


def figures() -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as path:
        made_apart(Path(path), bumps(side_mm=8.0))  # compiles
    for name in LENSES:
        lens = lens_of(name)
        with tempfile.TemporaryDirectory() as path:
            folder = Path(path)
            made = made_apart(folder, lens)
            megabytes = (folder / "finish.nc").stat().st_size / 1e6
            started = time.perf_counter()
            verdict = judge(read_chunks(folder / "finish.nc"), lens, FINISH)
            judged_s = time.perf_counter() - started
        note = f"CPU {made['cpu_s']:.0f} s with start; {verdict.lines:,} lines, {megabytes:.0f} MB; asked: 240 (90)"
        yield Figure(f"contour finish of {name}, made with file", made["wall_s"], "s", note)
        yield Figure("  memory", made["peak_gb"], "GB", "asked: below 3")
        yield from _path_figures(verdict)
        faults = "; ".join(verdict.faults) or "no faults"
        yield Figure("  checked", judged_s, "s", faults)


def _path_figures(verdict: PassCheck) -> Iterator[Figure]:
    path = verdict.contour
    assert path is not None
    gap = path.gap
    where = f"at X{gap.x_mm:.3f} Y{gap.y_mm:.3f}; asked: 1.02"
    nominal_s = verdict.path_length_mm / FEED_MM_PER_S
    yield Figure(
        "  entries, lifts, rapids inside", path.entries, "", f"{path.entries - 1}, {path.rapids_inside}; asked: 1, 0, 0"
    )
    yield Figure("  widest gap between tracks, everywhere", gap.width_mm / FINISH.pitch_mm, "pitches", where)
    yield Figure("  length x pitch / area", path.length_ratio, "", f"{path.length_mm / 1000:.0f} m; asked: 1.30 (1.18)")
    yield Figure("  along the contour where slope > 1 %", 100 * path.aligned_share, "%", "asked: 95 (98)")
    yield Figure("  turns over 60 degrees", path.turns_over_60_per_m, "per m", "asked: 0")
    yield Figure("  length with turn radius < 5 pitches", 100 * path.tight_turn_share, "%", "asked: 0.3")
    yield Figure(
        "  machine time over length / feed",
        verdict.time_s / nominal_s,
        "",
        f"{verdict.time_s / 3600:.1f} h; asked: 1.02",
    )
    yield Figure("  gouge", 1000 * verdict.gouge_um, "nm", "asked: 20")
    engagement = f"allowed {FINISH.step_down_mm:g} mm and the cusps before; climbing {100 * verdict.climb_share:.0f} %"
    yield Figure("  engagement", verdict.max_engagement_mm, "mm", engagement)


def window_of(lens: Heightfield) -> Heightfield:
    """The middle of a lens: as steep and as tight as all of it, and soon gone over."""
    ny, nx = lens.z_mm.shape
    rows, columns = (slice(round(n * (1 - WINDOW) / 2), round(n * (1 + WINDOW) / 2)) for n in (ny, nx))
    z_mm = lens.z_mm[rows, columns]
    size_mm = (z_mm.shape[1] - 1) * lens.dx_mm, (z_mm.shape[0] - 1) * lens.dy_mm
    return Heightfield.on_aperture(z_mm - z_mm.max() - 0.1, width_mm=size_mm[0], height_mm=size_mm[1])


def range_figures() -> Iterator[Figure]:
    """Every ball of the tool list at every pitch that plans may give it, scanned everywhere."""
    for tool, name in product(load_tools(), LENSES):
        window = window_of(lens_of(name, radius_mm=tool.radius_mm))
        shares, gaps, faults = {}, {}, []
        for pitch_mm in pitches_mm(tool):
            spec = replace(FINISH, radius_mm=tool.radius_mm, pitch_mm=pitch_mm)
            stock_top = skin_over(window, 0.25)
            verdict = judge(
                generate_program(window, spec, block_of(window), stock_top=stock_top, post=GRBL), window, spec
            )
            assert verdict.contour is not None
            shares[pitch_mm] = 100 * verdict.contour.aligned_share
            gaps[pitch_mm] = verdict.contour.gap.width_mm / pitch_mm
            faults += [f"{pitch_mm:g}: {fault}" for fault in verdict.faults]
        least, widest = min(shares, key=shares.__getitem__), max(gaps, key=gaps.__getitem__)
        note = f"least, at pitch {least:g}; of {len(shares)} pitches; asked: 95; " + ("; ".join(faults) or "no faults")
        yield Figure(f"R {tool.radius_mm:g} on {name}, along the contour", shares[least], "%", note)
        yield Figure("  widest gap between tracks", gaps[widest], "pitches", f"at pitch {widest:g}; asked: 1.02")


if __name__ == "__main__":
    print(json.dumps(make(Path(sys.argv[1]))))
