"""What stages need is compiled soon after the worker's start, where it was not yet: by a small job that nobody asked
for, so that the first person's need not wait for it.

A process of its own, `python -m service.worker.preparing PARENT`, that gives way to all others and ends with the thread
that started it; the mark of `kernel_cache` says for good that it was done.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from service.child_path import python_path
from service.kernel_cache import JOBS, ready_mark, use_current_kernels

_GIVES_WAY = 10  # of nice
_SMALL = ("image.pixels=32", "optics.width_mm=8", "optics.height_mm=8", "optics.throw_mm=40")


def begin() -> subprocess.Popen[bytes] | None:
    """The process, or None where nothing is left to compile."""
    if ready_mark(JOBS).exists():
        return None
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "service.worker.preparing", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": python_path()},
        start_new_session=True,
    )


def main(parent: int) -> None:
    from service.worker.linux import die_with_parent, name_process

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # its folder is taken away
    die_with_parent(parent, signal.SIGTERM)
    name_process("cm-preparing")
    os.nice(_GIVES_WAY)
    use_current_kernels()  # before numba is imported
    with tempfile.TemporaryDirectory() as folder:
        _make(Path(folder))
    with contextlib.suppress(OSError):
        ready_mark(JOBS).touch()


def _make(folder: Path) -> None:
    from PIL import Image

    from service.pipeline import make
    from service.progress import QuietReporter
    from service.spec_files import resolve_spec

    path = folder / "wedge.png"
    Image.linear_gradient("L").resize((64, 64)).save(path)
    make(path, folder / "job", resolve_spec(preset="draft", overrides=_SMALL), reporter=QuietReporter())


if __name__ == "__main__":
    main(int(sys.argv[1]))
