"""What stages need is compiled where it was not yet, by small jobs that nobody asked for: soon after a worker's start,
so that the first person's job need not wait for it, and beside a command whose first stages compile other kernels.

A process of its own, with TASK and PARENT as arguments, that gives way to all others and ends with the thread that
started it. It begins with light, while whoever waits for a lens solves its map; for whole jobs it goes on
with a lens and with reading a program, and another one, begun by it, makes programs for a lens that is there already
and shows them as milled. The marks of `kernel_cache` say that all is done.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from service.processes.kernel_cache import JOBS, LENSES, ready_mark, use_current_kernels
from service.processes.priority import give_way
from service.processes.source_tree import python_path

if TYPE_CHECKING:
    from service.job.spec.resolved import ResolvedJob

_PROGRAMS = "programs"
_SIDE_MM, _VERTICES, _RISE_MM = 8, 33, 0.3
_SMALL = (
    f"image.pixels={_VERTICES - 1}",
    f"optics.width_mm={_SIDE_MM}",
    f"optics.height_mm={_SIDE_MM}",
    "optics.throw_mm=40",
)
_PROGRAM = "G21 G90 G94 G17\nM3 S10000\nG0 X0 Y0 Z5\nG1 Z-1 F100\nX1 Y1\nM5\nM2\n"


def begin(task: str = JOBS) -> subprocess.Popen[bytes] | None:
    """Start the process; None where nothing of the task is left to compile. Somebody has to wait for its end."""
    return None if any(ready_mark(done).exists() for done in {task, JOBS}) else _start_process(task)


@contextmanager
def compile_beside(task: str) -> Iterator[None]:
    """Compile for this task while the block does it, which then leaves nothing to compile."""
    process = begin(task)
    try:
        yield
        if process is not None:
            _mark_ready(task)
    finally:
        if process is not None:
            process.terminate()
            process.wait()


def _mark_ready(task: str) -> None:
    with suppress(OSError):
        ready_mark(task).touch()


def _start_process(part: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "service.server.worker.warmup", part, str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": python_path()},
        start_new_session=True,
    )


def main(part: str, parent: int) -> int:
    from service.processes.linux import die_with_parent, name_process

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # its folder is taken away
    die_with_parent(parent, signal.SIGTERM)
    name_process("cm-preparing")
    give_way()
    other = _start_process(_PROGRAMS) if part == JOBS else None
    use_current_kernels()  # before numba is imported
    with tempfile.TemporaryDirectory() as folder:
        _PARTS[part](Path(folder))
    if other is not None and other.wait() != 0:
        return other.returncode
    if part == JOBS:
        _mark_ready(part)
    return 0


def _warm_lenses(folder: Path) -> None:
    from service.job.pipeline import simulate_caustic
    from service.progress import QuietReporter

    _put_dome(folder / "dome")
    simulate_caustic(folder / "dome", _resolve_small_job(), reporter=QuietReporter())


def _warm_jobs(folder: Path) -> None:
    from PIL import Image

    from machines.preflight.limits import limits_of
    from service.job.pipeline import design
    from service.milling.preflight_child import examine
    from service.progress import QuietReporter

    _warm_lenses(folder)
    picture, program = folder / "wedge.png", folder / "cut.nc"
    Image.linear_gradient("L").resize((64, 64)).save(picture)
    design(picture, folder / "lens", _resolve_small_job(), reporter=QuietReporter())
    program.write_text(_PROGRAM, encoding="ascii")
    examine(program, limits_of(_resolve_small_job().machine), lambda _: None)


def _warm_programs(folder: Path) -> None:
    from service.job.pipeline import make_programs
    from service.progress import QuietReporter

    _put_dome(folder / "dome")
    make_programs(folder / "dome", _resolve_small_job(), reporter=QuietReporter())


def _put_dome(folder: Path) -> None:
    """Write a lens that nobody had to compute, and an even picture."""
    import numpy as np

    from optics.heightfield import Heightfield
    from service.job.arrays import heightfield_bytes, target_bytes
    from service.job.files import HEIGHTFIELD, MAP

    arch = np.sin(np.linspace(0.0, np.pi, _VERTICES))
    heights_mm = _RISE_MM * (np.outer(arch, arch) - 1.5)
    lens = Heightfield.on_aperture(heights_mm, width_mm=_SIDE_MM, height_mm=_SIDE_MM)
    folder.mkdir()
    (folder / HEIGHTFIELD).write_bytes(heightfield_bytes(lens))
    (folder / MAP).write_bytes(target_bytes(np.ones((_VERTICES - 1, _VERTICES - 1))))


def _resolve_small_job() -> ResolvedJob:
    from service.job.spec.loading import resolve_job

    return resolve_job(preset="draft", overrides=_SMALL)


_PARTS = {LENSES: _warm_lenses, JOBS: _warm_jobs, _PROGRAMS: _warm_programs}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
