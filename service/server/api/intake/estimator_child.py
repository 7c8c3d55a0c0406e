"""The process that estimates jobs.

Request: {"path", "name", "max_pixels", "spec", "figures", "exactly", "plans"}. Result: the estimate. Request
{"prepare": true, "max_pixels"}: an estimate that no one reads, which compiles the missing kernels; the mark of
`kernel_cache` records permanently that it was made.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.processes.kernel_cache import ESTIMATES, ready_mark, use_current_kernels

use_current_kernels()  # before numba is imported

from PIL import Image  # noqa: E402

from service.job.picture import PictureLimits  # noqa: E402
from service.job.planning.estimate import estimate  # noqa: E402
from service.job.spec.loading import resolve_job, restore_job  # noqa: E402
from service.job.stages.kept_plans import KeptPlans  # noqa: E402
from service.processes.child_work import answer_requests  # noqa: E402

_BESIDE_BYTES = 4_000_000_000  # kernels, arrays of a lens of 1000 vertices, threads
_BYTES_PER_PIXEL = 16


def main() -> None:
    answer_requests("cm-estimates", _estimate, beside_bytes=_BESIDE_BYTES, bytes_per_pixel=_BYTES_PER_PIXEL)


def _estimate(asked: dict[str, Any], _: Callable[[float], None]) -> dict[str, Any]:
    limits = PictureLimits(max_pixels=asked["max_pixels"])
    if "prepare" in asked:
        return _prepare(limits)
    job, path, exactly = restore_job(asked["spec"], asked["figures"]), Path(asked["path"]), asked["exactly"]
    plans = KeptPlans(Path(asked["plans"]))
    return estimate(job, path, limits=limits, name=asked["name"], exactly=exactly, plans=plans)


def _prepare(limits: PictureLimits) -> dict[str, Any]:
    """Estimate a small job with a picture from black to white: it calls every kernel that a large one calls."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wedge.png"
        Image.linear_gradient("L").save(path)
        small = ["optics.width_mm=30", "optics.height_mm=30", "optics.throw_mm=100"]
        estimate(resolve_job(preset="recommended", overrides=small), path, limits=limits, name=path.name)
    with contextlib.suppress(OSError):
        ready_mark(ESTIMATES).touch()
    return {}


if __name__ == "__main__":
    main()
