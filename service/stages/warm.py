"""Importing this imports what the lens is computed with, so that a process forked afterwards starts at once.

`LATER` is what other stages need, piece by piece, to be imported when there is time. Nothing of this starts a
thread or compiles anything.
"""

from __future__ import annotations

from service.kernel_cache import use_current_kernels

use_current_kernels()  # before numba is imported

from service.stages import lens, run  # noqa: E402

LATER = (
    "service.stages.light",
    "service.stages.programs",
    "service.stages.final_check",
    "service.stages.sheet",
    "networkx",
    "trimesh",
    "manifold3d",
    "matplotlib.figure",
    "matplotlib.axes",
    "service.solid",
    "service.figures",
    "service.figures_lens",
    "service.figures_tolerances",
    "service.figures_paths",
    "service.drawing.focus",
)

__all__ = ["LATER", "lens", "run"]
