"""Is every object of the store still what its name says?"""

from __future__ import annotations

import hashlib

from service.errors import FailedError
from service.settings import ServerSettings
from service.store.base import MissingObjectError
from service.store.opening import open_store


def verify_store(settings: ServerSettings) -> list[str]:
    """Verify every object; FailedError names each that is not what it is called."""
    store, count, size, damaged = open_store(settings), 0, 0, []
    for stored in store.list():
        digest = hashlib.sha256()
        try:
            for piece in store.open_range(stored.sha256):
                digest.update(piece)
        except MissingObjectError:  # deleted meanwhile
            continue
        count, size = count + 1, size + stored.bytes
        if digest.hexdigest() != stored.sha256:
            damaged.append(stored.sha256)
    if damaged:
        raise FailedError(*(f"object {sha256} is damaged" for sha256 in damaged))
    return [f"{count} objects, {size / 1e6:.1f} MB: all are what they were stored as"]
