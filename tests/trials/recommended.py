"""`recommended` on every bundled profile, six pictures and three sizes: its programs against what is told of them.

Designs have 256 pixels across, where a job has 512: the laws are those of tools, entries and hours. Told are the plan
and the report; against them stand the written files, read back and cut once more here, and pre-flight's own time.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import skimage

from cam.checking.check import RAPID_CLEARANCE_MM
from cam.checking.removal import RemovalGrid
from cam.duration import DurationModel, Kinematics
from cam.reading.gcode import LANGUAGES, read_parts
from cam.surface.stock_grid import StockGrid
from machines.preflight.preflight import limits_of
from machines.profile import profile_names
from service.job import pipeline
from service.job.files import files_of_pass, read_chunks
from service.job.spec.loading import load_stored_job, resolve_job
from service.job.spec.resolve import ResolvedJob, cam_passes_of, cam_stock_of
from service.job.stages.programs import first_stock
from service.milling.preflight_child import examine
from service.progress import QuietReporter
from tests.benchmarks.timing import Figure

PIXELS = 256
MOST_OFF = 0.05  # of the hours
EXAMPLES, SKIMAGE = Path(__file__).parents[2] / "examples", Path(skimage.__file__).parent / "data"
PICTURES = (
    *(EXAMPLES / name for name in ("camera.png", "astronaut.png", "logo.png")),
    *(SKIMAGE / name for name in ("chelsea.png", "coffee.png", "rocket.jpg")),
)
BENCHES_MM = ((40, 100), (60, 200), (100, 100))
"""Width of the lens and throw."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A case: hours by plan, report, file and pre-flight; entries by report and file; descents that cut nothing."""

    hours: tuple[float, float, float, float]
    entries: tuple[int, int]
    idle: int
    balls_mm: tuple[float, ...]
    unheld: bool

    def broken(self) -> str:
        plan, report, file, preflight = self.hours
        off = max(abs(one / file - 1) for one in (plan, report, preflight))
        faults = (
            (off > MOST_OFF, f"hours {100 * off:.1f} % off"),
            (self.entries[0] != self.entries[1], f"entries {self.entries}"),
            (self.idle > 0, f"{self.idle} descents cut nothing"),
            (self.unheld, "a tool beyond the collet"),
        )
        return ", ".join(words for is_broken, words in faults if is_broken)


def figures() -> Iterator[Figure]:
    for (width_mm, throw_mm), picture, machine in product(BENCHES_MM, PICTURES, profile_names(())):
        row = measure(picture, machine, width_mm, throw_mm)
        words = (
            f"balls {row.balls_mm}, hours of plan, report, file, pre-flight {[round(one, 3) for one in row.hours]}, "
            f"entries told, counted {row.entries}, idle {row.idle}"
        )
        note = f"BROKEN: {row.broken()}: {words}" if row.broken() else words
        yield Figure(f"{machine} {picture.stem} {width_mm} mm", row.hours[2], "h", note)


def measure(picture: Path, machine: str, width_mm: float, throw_mm: float) -> Row:
    sizes = (f"optics.width_mm={width_mm}", f"optics.height_mm={width_mm}", f"optics.throw_mm={throw_mm}")
    given = (*sizes, f"image.pixels={PIXELS}", f"machine.profile='{machine}'")
    with tempfile.TemporaryDirectory() as folder:
        made, job = Path(folder) / "job", resolve_job(file=None, preset="recommended", overrides=given)
        report = pipeline.make(picture, made, job, reporter=QuietReporter())
        resolved = load_stored_job(made)
        limits, rows = limits_of(resolved.machine), report["passes"]
        names = [name for row in rows for name, _ in files_of_pass(row)]
        waited_s = sum(examine(made / name, limits, lambda share: None).time_s for name in names)
        file_s, entries, idle = _cut(made, resolved, rows)
        collet_mm = resolved.machine.collet_mm or np.inf
        thickest = max(2 * (one.shank_radius_mm or one.radius_mm) for one in resolved.spec.passes)
        told_s = sum(row["time_s"] for row in rows)
        return Row(
            hours=(report["plan"]["hours"], told_s / 3600, file_s / 3600, waited_s / 3600),
            entries=(sum(row["entries"] for row in rows), entries),
            idle=idle,
            balls_mm=tuple(one.radius_mm for one in resolved.spec.passes),
            unheld=thickest > collet_mm,
        )


def _cut(made: Path, job: ResolvedJob, rows: list[dict[str, object]]) -> tuple[float, int, int]:
    """Return (seconds, descents that cut, descents that cut nothing) of all programs as they are read back."""
    seconds, entries, idle, left = 0.0, 0, 0, first_stock(cam_stock_of(job.spec))
    for row, spec in zip(rows, cam_passes_of(job.spec), strict=True):
        paths = [made / name for name, _ in files_of_pass(row)]
        took_s, cuts, left = _cut_pass(paths, job, spec.radius_mm, left)
        seconds, entries, idle = seconds + took_s, entries + int(cuts.sum()), idle + int((~cuts).sum())
    return seconds, entries, idle


def _cut_pass(
    paths: list[Path], job: ResolvedJob, radius_mm: float, left: StockGrid
) -> tuple[float, np.ndarray, StockGrid]:
    """Return the seconds of a pass, whether each descent (feeds under Z0 without a break) cuts, and the stock left."""
    duration = DurationModel(Kinematics.of(job.machine))
    grid = RemovalGrid(left, radius_mm=radius_mm, rapid_clearance_mm=RAPID_CLEARANCE_MM)
    depths, feeds = [np.zeros(1)], []
    for batch in read_parts(map(read_chunks, paths), LANGUAGES[job.machine.dialect]):
        duration.add(batch)
        drops = grid.cut(batch)
        depths[-1][-1] = max(depths[-1][-1], drops.depth_mm[0])
        depths.append(drops.depth_mm[1:].copy())
        is_low = np.minimum(batch.start_mm[:, 2], batch.end_mm[:, 2]) <= 0  # of the air: Z0 is the top of the block
        feeds.append(is_low & ~batch.is_rapid & batch.spindle_on)
    feeding, depth_mm = np.concatenate(feeds), np.concatenate(depths)[1:]
    descent = np.cumsum(feeding & ~np.concatenate(([False], feeding[:-1])))
    cuts = np.zeros(descent[-1] + 1, dtype=bool)
    np.logical_or.at(cuts, descent[feeding], depth_mm[feeding] > 1e-6)
    return duration.seconds, cuts[1:], grid.stock()
