"""The artifact store in an S3 bucket: <prefix>/ab/<sha256>, for farms. Needs the extra `s3`.

Address and credentials come from the usual AWS_... variables (AWS_ENDPOINT_URL for another provider than Amazon; plain
http only on loopback, or where AWS_ALLOW_HTTP says so). Files go up in parts, so memory does not grow with their
size, and an object appears when its last part is confirmed. A killed upload leaves parts that no reader can see: give
the bucket a rule that drops incomplete multipart uploads.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from service.errors import FailedError, InputError, printable
from service.http.hosts import is_loopback
from service.store.base import MissingObjectError, StoredObject
from service.store.local import write_verified

if TYPE_CHECKING:
    from obstore.store import S3Store as Bucket

_PART_BYTES = 8 << 20
_PIECE_BYTES = 1 << 20
_AT_ONCE = 4
_LINK_LIFE = timedelta(minutes=10)
_YOUNG_S = 600.0
_HASH = re.compile(r"[0-9a-f]{64}")
_NOBODY = re.compile(
    r"//169\.254\.(169\.254|170\.2)/"
)  # credentials from the computer's own identity were the last try, and failed
_NOISE = re.compile(r"^Generic \w+ error: | in [\d.]+m?s\b(, after \d+ retries, max_retries.*?retry_timeout: \w+)? ?")
_RETRY = {"max_retries": 5, "retry_timeout": timedelta(seconds=20)}


class S3Store:
    """Objects in a bucket, shared by all hosts that have its credentials."""

    shared = True

    def __init__(self, *, bucket: str, prefix: str) -> None:
        self._name = f"s3://{bucket}/{prefix}".rstrip("/")
        self._bucket = _open_bucket(bucket, prefix)

    def put_file(self, path: Path) -> StoredObject:
        """Upload a file unless it is there already. FailedError, one line, if the network or the bucket refuses."""
        import obstore

        try:
            with path.open("rb") as file:
                before = os.fstat(file.fileno())
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
                if (there := self._find_recent(sha256, before.st_size)) is not None:
                    return there
                file.seek(0)
                with self._translate_errors("store", sha256):
                    obstore.put(self._bucket, _key(sha256), file, chunk_size=_PART_BYTES, max_concurrency=_AT_ONCE)
                after = os.fstat(file.fileno())
        except OSError as error:
            raise FailedError(f"cannot store {path}: {(error.strerror or str(error)).lower()}") from None
        stored = self.head(sha256)
        if stored.bytes != before.st_size or before.st_mtime_ns != after.st_mtime_ns:
            self.delete(sha256)
            raise FailedError(f"cannot store {path}: {self._name} holds other bytes than were sent")
        return stored

    def head(self, sha256: str) -> StoredObject:
        import obstore

        with self._translate_errors("look for", sha256):
            facts = obstore.head(self._bucket, _key(sha256))
        return StoredObject(sha256=sha256, bytes=facts["size"], stored_at=facts["last_modified"].timestamp())

    def open_range(self, sha256: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        import obstore

        size = self.head(sha256).bytes
        end = size if end is None else min(end, size)
        if start >= end:
            return iter(())
        with self._translate_errors("read", sha256):
            answer = obstore.get(self._bucket, _key(sha256), options={"range": (start, end)})
        return self._pieces(answer.stream(min_chunk_size=_PIECE_BYTES), sha256)

    def fetch(self, sha256: str, target: Path) -> None:
        try:
            target.unlink(missing_ok=True)
            write_verified(self.open_range(sha256), target, sha256)
        except OSError as error:
            raise FailedError(f"cannot fetch an artifact to {target}: {(error.strerror or '').lower()}") from None

    def url(self, sha256: str, *, file_name: str, media_type: str) -> str | None:
        """Sign an address for ten minutes. The bucket serves bytes named by their hash: obstore signs no other
        headers.
        """
        import obstore

        with self._translate_errors("sign an address for", sha256):
            return obstore.sign(self._bucket, "GET", _key(sha256), _LINK_LIFE)

    def path(self, sha256: str) -> Path | None:
        return None

    def delete(self, sha256: str, *, stored_before: float | None = None) -> None:
        import obstore

        with contextlib.suppress(MissingObjectError):
            if stored_before is None or self.head(sha256).stored_at < stored_before:
                with self._translate_errors("delete", sha256):
                    obstore.delete(self._bucket, _key(sha256))

    def list(self, prefix: str = "") -> Iterator[StoredObject]:
        import obstore

        with self._translate_errors("list", ""):
            for page in obstore.list(self._bucket, prefix or None, chunk_size=1000):
                for facts in page:
                    name = facts["path"].rpartition("/")[2]
                    if _HASH.fullmatch(name):
                        stored_at = facts["last_modified"].timestamp()
                        yield StoredObject(sha256=name, bytes=facts["size"], stored_at=stored_at)

    def check(self) -> None:
        import obstore

        word, key = secrets.token_bytes(32), f"check/{secrets.token_hex(8)}"
        with self._translate_errors("use", key):
            obstore.put(self._bucket, key, word)
            answer = bytes(obstore.get(self._bucket, key).bytes())
            obstore.delete(self._bucket, key)
        if answer != word:
            raise FailedError(f"{self._name} does not return what is written to it")

    def _find_recent(self, sha256: str, size: int) -> StoredObject | None:
        """Return the object if it is complete and far from being swept; anything else is sent again, which renews its
        time.
        """
        with contextlib.suppress(MissingObjectError):
            there = self.head(sha256)
            if there.bytes == size and there.stored_at > time.time() - _YOUNG_S:
                return there
        return None

    def _pieces(self, answer: Any, sha256: str) -> Iterator[bytes]:
        with self._translate_errors("read", sha256):
            for chunk in answer:
                view = memoryview(chunk)
                for at in range(0, len(view), _PIECE_BYTES):
                    yield bytes(view[at : at + _PIECE_BYTES])

    @contextlib.contextmanager
    def _translate_errors(self, doing: str, sha256: str) -> Iterator[None]:
        from obstore import exceptions

        try:
            yield
        except (exceptions.NotFoundError, FileNotFoundError) as error:
            if "NoSuchBucket" in str(error):
                raise FailedError(f"cannot {doing} {self._name}: there is no such bucket") from None
            raise MissingObjectError(sha256) from None
        except exceptions.BaseError as error:
            raise FailedError(f"cannot {doing} {self._name}: {_first_words(error)}") from None


def _key(sha256: str) -> str:
    if not _HASH.fullmatch(sha256):
        raise MissingObjectError(sha256)
    return f"{sha256[:2]}/{sha256}"


def _open_bucket(bucket: str, prefix: str) -> Bucket:
    try:
        from obstore import exceptions
        from obstore.store import S3Store as Bucket
    except ImportError:
        raise InputError(
            "CAUSTICMILL_STORE_URL: an s3:// store needs the extra s3: pip install 'causticmill[s3]'"
        ) from None
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    options: dict[str, Any] = {"connect_timeout": timedelta(seconds=5), "timeout": timedelta(minutes=10)}
    if endpoint and urlsplit(endpoint).scheme == "http" and is_loopback(urlsplit(endpoint).hostname or ""):
        options["allow_http"] = True
    given: dict[str, Any] = {"endpoint": endpoint} if endpoint else {}
    try:
        return Bucket(bucket, prefix=prefix or None, client_options=options, retry_config=_RETRY, **given)  # type: ignore[arg-type]
    except exceptions.BaseError as error:
        raise InputError(f"CAUSTICMILL_STORE_URL: s3://{bucket}: {_first_words(error)}") from None


def _first_words(error: Exception) -> str:
    """Return an error's text without the parts that only the library's authors can use."""
    text = str(error).split("\n")[0]
    if _NOBODY.search(text):
        return "no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    return printable(_NOISE.sub("", text).strip())[:300]
