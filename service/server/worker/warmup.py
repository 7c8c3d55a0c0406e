"""Compiles the kernels that stages need by running small jobs: soon after a worker's start, so that the first job need
not wait, and alongside a command whose first stages compile other kernels.

It is a child process of the lowest priority. It begins with light, while the command solves the map of its lens. For
whole jobs it goes on with a lens and with reading a program; it starts a second child, which makes programs for an
existing lens and simulates them as milled. The marks of `kernel_cache` record what is done.
"""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import ServiceError
from service.processes.child import Child, ChildError
from service.processes.kernel_cache import JOBS, LENSES, ready_mark, use_current_kernels

if TYPE_CHECKING:
    from service.job.spec.resolve import ResolvedJob

_PROGRAMS = "programs"
_SIDE_MM, _VERTICES, _RISE_MM = 8, 33, 0.3
_SMALL = (
    f"image.pixels={_VERTICES - 1}",
    f"optics.width_mm={_SIDE_MM}",
    f"optics.height_mm={_SIDE_MM}",
    "optics.throw_mm=40",
)
_PROGRAM = "G21 G90 G94 G17\nM3 S10000\nG0 X0 Y0 Z5\nG1 Z-1 F100\nX1 Y1\nM5\nM2\n"


def begin(task: str = JOBS) -> Child | None:
    """Start the process; None if nothing of the task is left to compile. The caller ends the process."""
    return None if any(ready_mark(done).exists() for done in {task, JOBS}) else _begin_part(task)


def compile_for_jobs() -> None:
    """Compile the kernels of jobs, and return when they are done."""
    if (child := begin()) is not None:
        try:
            with suppress(ChildError, ServiceError):  # the first job compiles what is missing
                child.finish()
        finally:
            child.end(signal.SIGTERM)


@contextmanager
def compile_beside(task: str) -> Iterator[None]:
    """Compile for this task while the `with` block performs it; when the block ends, nothing is left to compile."""
    child = begin(task)
    try:
        yield
        if child is not None:
            _mark_ready(task)
    finally:
        if child is not None:
            child.end(signal.SIGTERM)


def _mark_ready(task: str) -> None:
    with suppress(OSError):
        ready_mark(task).touch()


def _begin_part(part: str) -> Child:
    child = Child("service.server.worker.warmup")
    child.begin({"part": part})
    return child


def main() -> None:
    from service.processes.child_work import answer_requests

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # its folder is being removed
    answer_requests("cm-preparing", _compile, parent_ends_it_with=signal.SIGTERM)


def _compile(request: dict[str, Any], _: Callable[[float], None]) -> dict[str, Any]:
    part = request["part"]
    other = _begin_part(_PROGRAMS) if part == JOBS else None
    try:
        use_current_kernels()  # before numba is imported
        with tempfile.TemporaryDirectory() as folder:
            _PARTS[part](Path(folder))
        if other is not None:
            other.finish()
            _mark_ready(part)
    finally:
        if other is not None:
            other.end(signal.SIGTERM)
    return {}


def _warm_lenses(folder: Path) -> None:
    from service.job.pipeline import simulate_caustic
    from service.progress import QuietReporter

    _put_dome(folder / "dome")
    simulate_caustic(folder / "dome", _resolve_small_job(), reporter=QuietReporter())


def _warm_jobs(folder: Path) -> None:
    from PIL import Image

    from machines.preflight.preflight import limits_of
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
    """Write a lens that needs no computing, and an even picture."""
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
    main()
