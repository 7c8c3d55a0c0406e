"""The S3 server of the store's tests serves the farm's, too."""

from __future__ import annotations

from tests.service.store.conftest import s3_address, s3_urls

__all__ = ["s3_address", "s3_urls"]
