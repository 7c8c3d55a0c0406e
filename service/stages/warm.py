"""Importing this imports everything that a stage may need, so that a process forked afterwards starts at once.

It starts no thread and compiles nothing.
"""

from __future__ import annotations

from service.kernel_cache import use_current_kernels

use_current_kernels()  # before numba is imported

from service.stages import final_check, lens, light, programs, run, sheet  # noqa: E402

__all__ = ["final_check", "lens", "light", "programs", "run", "sheet"]
