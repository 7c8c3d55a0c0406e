"""Settings of the whole suite."""

from __future__ import annotations

import signal

from hypothesis import settings

from service.kernel_cache import use_current_kernels

use_current_kernels()  # before any test module imports numba

# Kernels compile on their first call, so an example may take seconds; their order is fixed to keep CI repeatable.
settings.register_profile("causticmill", deadline=None, derandomize=True, max_examples=50, print_blob=True)
settings.load_profile("causticmill")

# A runner under nohup hands its ignored SIGHUP down to every command that the tests start.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
