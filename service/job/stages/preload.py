"""Importing this module imports the libraries that compute the lens, so that a process forked afterwards starts at
once.

`LATER` lists modules of other stages, to be imported piece by piece when there is time. None of them starts a thread or
compiles anything.
"""

from __future__ import annotations

from service.processes.kernel_cache import use_current_kernels

use_current_kernels()  # before numba is imported

from service.job.stages import lens, run  # noqa: E402

DRAWING = (
    "matplotlib.figure",
    "matplotlib.axes",
    "service.job.report.figures.base",
    "service.job.report.figures.lens",
    "service.job.report.figures.paths",
    "service.job.report.figures.wall",
    "service.job.report.setup_pdf",
    "fontTools.subset",
)

LATER = (
    "service.job.stages.light",
    "service.job.stages.programs",
    "service.job.stages.check",
    "trimesh",
    "manifold3d",
    *DRAWING,
    "service.job.report.solid",
)

__all__ = ["LATER", "lens", "run"]
