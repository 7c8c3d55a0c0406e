"""Pre-flight's time against the simulated mill's, for the three programs of a small lens."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from machines.driver import Faulted, MillState, ProgramDone
from machines.gcode.program import ProgramReader
from machines.grbl.driver import GrblDriver
from machines.profile import load_profile
from machines.simulated import GRBL_11, MemoryPort, Recording, SimulatedMill
from service.job import pipeline
from service.job.spec.loading import resolve_job
from service.milling.preflight import run_preflight
from service.progress import QuietReporter

PICTURE = Path(__file__).parents[2] / "examples" / "camera.png"


def compared(width_mm: float) -> Iterator[tuple[str, float, float]]:
    """(program, estimated seconds, seconds on the simulated mill) for a lens of that size with the paper's passes."""
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder) / "job"
        sizes = (f"optics.width_mm={width_mm}", f"optics.height_mm={width_mm}", "image.pixels=64", "optics.throw_mm=30")
        pipeline.make(PICTURE, job, resolve_job(file=None, preset="paper", overrides=sizes), reporter=QuietReporter())
        for program in sorted(job.glob("*.nc")):
            mill = SimulatedMill(GRBL_11, recording=Recording(keep=False))
            driver = GrblDriver(MemoryPort(mill, baud=115200))
            driver.connect()
            while driver.status.state is not MillState.IDLE or driver.settings.values == {}:
                driver.poll(0.1)
            facts = run_preflight(program, load_profile("grbl"), settings=driver.settings, cache=Path(folder) / "cache")
            began_s = mill.now_s
            driver.start(ProgramReader(program, facts.index).lines())
            while not _ended(driver):
                pass
            yield program.name, facts.time_s, mill.now_s - began_s


def _ended(driver: GrblDriver) -> bool:
    for event in driver.poll(1.0):
        if isinstance(event, Faulted):
            raise RuntimeError(f"the clean link faulted: {event.words}")
        if isinstance(event, ProgramDone):
            return True
    return False
