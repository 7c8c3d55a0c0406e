"""Where numba keeps compiled kernels, one folder for each state of the sources; and one thread for the linear algebra.

numba's file cache notices a change in a kernel's own file, but not in a kernel of another file that it calls; after an
update it would go on with the old one, and on a mill an old kernel is a wrong cut.

Linear algebra libraries add up in another order when they use another number of threads, so that the same job would
have other last digits, and other hashes, on another computer. Our own kernels use threads where that gains time.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from functools import cache
from importlib.metadata import version
from pathlib import Path

from service.private import make_private

ESTIMATES, JOBS = "estimates", "jobs"  # tasks of `ready_mark`

_KEPT = 3  # states of the sources
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def use_current_kernels() -> None:
    """Point numba's cache at this source state's folder; to be called before numpy and numba are imported.

    A NUMBA_CACHE_DIR set by the user stays.
    """
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    folder = _folder()
    try:
        make_private(folder)  # what others could write here would run as ours
        folder.touch()
        states = sorted(folder.parent.glob("kernels-*"), key=lambda path: path.stat().st_mtime)
        for old in states[:-_KEPT]:
            shutil.rmtree(old, ignore_errors=True)
    except OSError:
        return  # no home to write to: numba falls back to its own choice
    os.environ["NUMBA_CACHE_DIR"] = str(folder)


def ready_mark(task: str) -> Path:
    """A file beside the kernels: there once all that this task needs is compiled, as our sources and numba are now."""
    return _folder() / f"{task}-{version('numba')}-{_state_of_sources()}.ready"


def _folder() -> Path:
    if "NUMBA_CACHE_DIR" in os.environ:
        return Path(os.environ["NUMBA_CACHE_DIR"])
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "causticmill" / f"kernels-{_state_of_sources()}"


@cache
def _state_of_sources() -> str:
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for package in ("optics", "cam", "machines/gcode"):
        for source in sorted((root / package).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
