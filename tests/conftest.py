"""Settings of the whole suite."""

from __future__ import annotations

from hypothesis import settings

# Kernels compile on their first call, so single examples may take seconds; example order is fixed to keep CI repeatable.
settings.register_profile("causticmill", deadline=None, derandomize=True, max_examples=50, print_blob=True)
settings.load_profile("causticmill")
