"""Settings of the whole suite."""

from __future__ import annotations

import ctypes
import gc
import signal

import pytest
from hypothesis import settings

from service.processes.kernel_cache import use_current_kernels
from tests import order
from tests.levels import THOROUGH

use_current_kernels()  # before any test module imports numba
# Freed arrays of up to 256 MB stay with the process, where this is glibc: given back to the system and taken anew, each
# is filled with zeros first, which is up to a fifth of a job's time.
for _M_MMAP_OR_TRIM_THRESHOLD in (-3, -1):
    getattr(ctypes.CDLL(None), "mallopt", max)(_M_MMAP_OR_TRIM_THRESHOLD, 1 << 28)
gc.disable()  # a million objects are made while tests are collected, and all of them stay

# Kernels compile on their first call, so an example may take seconds; their order is fixed to keep CI repeatable.
settings.register_profile(
    "causticmill", deadline=None, derandomize=True, max_examples=50 if THOROUGH else 25, print_blob=True
)
settings.load_profile("causticmill")

# A runner under nohup, or in the background of a script, hands the signals that it ignores down to every command that
# the tests start.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What `make test` has no time for is run where time is: see tests/levels.py."""
    if not THOROUGH:
        skip = pytest.mark.skip(reason="thorough: runs with CAUSTICMILL_SLOW=1, as in .ci/run")
        for item in items:
            if item.get_closest_marker("thorough"):
                item.add_marker(skip)
    order.in_good_order(items)


def pytest_collection_finish() -> None:
    gc.freeze()  # what stays need not be looked at again with what tests leave behind
    gc.enable()


def pytest_xdist_auto_num_workers() -> int:
    return order.processes()


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> order.Scheduling:
    return order.Scheduling(config, log)
