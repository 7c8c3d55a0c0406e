"""Sets numba's cache of compiled kernels, each under the hash of its code, and limits linear algebra to one thread.

`kernel_locator.py` names them: numba's file cache notices a change in a kernel's own file, but not in a kernel of
another file that it calls, and on a mill an outdated kernel means a wrong cut.

Linear algebra libraries add in another order when they use another number of threads, so the same job would have other
last digits, and other hashes, on another computer. Our own kernels use threads where that saves time.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from functools import cache
from importlib.metadata import version
from pathlib import Path

from service.processes.files import make_private
from service.processes.source_tree import hash_files

ESTIMATES, LENSES, JOBS = "estimates", "lenses", "jobs"  # tasks of `ready_mark`

_UNUSED_S = 30 * 86400.0  # after which a kernel is deleted
_LOCATORS = (
    "service.processes.kernel_locator.KernelLocator,UserProvidedCacheLocator"  # the latter for kernels of others
)
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_COMPILED = {"NUMBA_LOOP_VECTORIZE": "0"}  # compiling takes a seventh less, and none of our kernels is slower


def use_current_kernels() -> None:
    """Point numba's cache at a folder for kernels by their code; to be called before numpy and numba are imported.

    A NUMBA_CACHE_DIR set by the user stays.
    """
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1") | _COMPILED)
    if "NUMBA_CACHE_DIR" not in os.environ:
        folder = _folder()
        try:
            make_private(folder)  # code that others could write here would run as ours
        except OSError:
            return  # no home to write to: numba falls back to its own choice
        _delete_unused(folder)
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
    os.environ["NUMBA_CACHE_LOCATOR_CLASSES"] = _LOCATORS


def _delete_unused(folder: Path) -> None:
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process may do the same
            if time.time() - path.stat().st_mtime > _UNUSED_S:
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink()


def ready_mark(task: str) -> Path:
    """Return a mark file beside the kernels, which exists once everything for this task is compiled for the present
    sources and numba.
    """
    return _folder() / f"{task}-{version('numba')}-{_state_of_sources()}.ready"


def _folder() -> Path:
    if "NUMBA_CACHE_DIR" in os.environ:
        return Path(os.environ["NUMBA_CACHE_DIR"])
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "causticmill" / "kernels"


@cache
def _state_of_sources() -> str:
    root = Path(__file__).parents[2]
    packages = ("optics", "cam", "machines/gcode")
    return hash_files(path for package in packages for path in sorted((root / package).rglob("*.py")))[:16]
