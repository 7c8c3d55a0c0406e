"""Opens the artifact store that the settings ask for, and checks that the database may be used with it."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

from service.errors import InputError
from service.settings import ServerSettings
from service.store.base import Store
from service.store.local import LocalStore

_DATABASES = ("postgresql", "postgres")
_ALLOWED = "allowed: file:///folder, s3://bucket/prefix, or nothing for a folder beside the database"


def open_store(settings: ServerSettings) -> Store:
    """Open the store. InputError if the setting names no store, or one that workers on other hosts cannot reach;
    FailedError if opening fails.
    """
    if settings.database_url is not None and urlsplit(settings.database_url).scheme not in _DATABASES:
        raise InputError("CAUSTICMILL_DATABASE_URL: allowed: postgresql://..., or nothing for a SQLite file")
    store = _store(settings)
    if not settings.embedded and not store.shared:
        raise InputError(
            "CAUSTICMILL_DATABASE_URL: workers on other hosts could not read this artifact store; allowed: "
            "CAUSTICMILL_STORE_URL=s3://bucket/prefix, or file:///folder with CAUSTICMILL_STORE_IS_SHARED=true "
            "where that folder is the same on every host"
        )
    return store


def _store(settings: ServerSettings) -> Store:
    if settings.store_url is None:
        return LocalStore(settings.data / "objects")
    url = urlsplit(settings.store_url)
    if url.scheme == "file" and url.netloc in ("", "localhost") and url.path.startswith("/"):
        return LocalStore(Path(unquote(url.path)), shared=settings.store_is_shared)
    if url.scheme == "s3" and url.netloc:
        from service.store.s3 import S3Store

        return S3Store(bucket=url.netloc, prefix=url.path.strip("/"))
    raise InputError(f"CAUSTICMILL_STORE_URL: {settings.store_url!r} is not an artifact store; {_ALLOWED}")
