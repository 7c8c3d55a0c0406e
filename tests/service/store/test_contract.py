"""What every store promises, held against the folder and against a real server of the S3 protocol."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from service.errors import FailedError
from service.store.base import MissingObjectError, Store
from tests.waiting import PATIENCE_S

Written = Callable[[bytes], Path]
CONTENT = bytes(range(256)) * 5000  # 1.28 MB: more than one piece
SHA256 = hashlib.sha256(CONTENT).hexdigest()


def test_what_is_stored_comes_back_whole(store: Store, written: Written, tmp_path: Path) -> None:
    before = time.time()
    stored = store.put_file(written(CONTENT))
    assert (stored.sha256, stored.bytes) == (SHA256, len(CONTENT))
    assert before - 2 <= stored.stored_at <= time.time() + 2
    assert store.head(SHA256) == stored
    pieces = list(store.open_range(SHA256))
    assert b"".join(pieces) == CONTENT
    assert max(map(len, pieces)) <= 1 << 20
    store.fetch(SHA256, tmp_path / "fetched")
    assert (tmp_path / "fetched").read_bytes() == CONTENT
    assert (tmp_path / "fetched").stat().st_mode & 0o222 == 0


@pytest.mark.parametrize(
    ("start", "end"),
    [(0, 1), (5, 5), (100, 1_000_000), (1_279_999, None), (1_279_990, 9_999_999), (1_280_000, None), (2_000_000, None)],
)
def test_ranges_are_slices(store: Store, written: Written, start: int, end: int | None) -> None:
    store.put_file(written(CONTENT))
    assert b"".join(store.open_range(SHA256, start, end)) == CONTENT[start:end]


def test_an_empty_file_is_an_object(store: Store, written: Written) -> None:
    stored = store.put_file(written(b""))
    assert stored.bytes == 0
    assert b"".join(store.open_range(stored.sha256)) == b""


def test_same_content_is_stored_once(store: Store, written: Written) -> None:
    first = store.put_file(written(CONTENT))
    again = store.put_file(written(CONTENT))
    assert again.sha256 == first.sha256
    assert [item.sha256 for item in store.list()] == [first.sha256]


def test_a_part_of_the_list_is_that_of_the_first_digits(store: Store, written: Written) -> None:
    hashes = {store.put_file(written(b"%d" % number)).sha256 for number in range(10)}
    for part in {sha256[:2] for sha256 in hashes} | {"00"}:
        assert {one.sha256 for one in store.list(part)} == {sha256 for sha256 in hashes if sha256[:2] == part}


def test_a_large_file_goes_up_in_parts(store: Store, written: Written) -> None:
    content = CONTENT * 16  # 20 MB: three parts
    stored = store.put_file(written(content))
    assert hashlib.sha256(b"".join(store.open_range(stored.sha256))).hexdigest() == stored.sha256


def test_deleting_is_final_and_may_be_repeated(store: Store, written: Written) -> None:
    store.put_file(written(CONTENT))
    store.delete(SHA256)
    store.delete(SHA256)
    assert list(store.list()) == []
    with pytest.raises(MissingObjectError):
        store.head(SHA256)


def test_what_was_stored_again_is_not_swept(store: Store, written: Written) -> None:
    """The sweeper looked before the second storing: its delete, by that time, changes nothing."""
    stored = store.put_file(written(CONTENT))
    store.delete(SHA256, stored_before=stored.stored_at)
    assert store.head(SHA256) == stored
    store.delete(SHA256, stored_before=stored.stored_at + 10)
    assert list(store.list()) == []


def test_what_is_stored_now_is_new_however_old_the_file_is(store: Store, written: Written) -> None:
    """Else a stage that takes longer than the sweeper's grace would lose what it has just stored."""
    path, before = written(CONTENT), time.time()
    os.utime(path, (before - 7200, before - 7200))
    stored = store.put_file(path)
    assert stored.stored_at >= before - 2
    store.delete(SHA256, stored_before=before - 3600)
    assert store.head(SHA256) == stored


@pytest.mark.parametrize("name", ["0" * 64, "../../etc/passwd", "", "ABC", SHA256.upper(), SHA256 + "\n"])
def test_what_is_not_there_is_missing_whatever_is_asked(store: Store, tmp_path: Path, name: str) -> None:
    with pytest.raises(MissingObjectError):
        store.head(name)
    with pytest.raises(MissingObjectError):
        store.open_range(name)
    with pytest.raises(MissingObjectError):
        store.fetch(name, tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def test_a_missing_file_is_one_line(store: Store, tmp_path: Path) -> None:
    with pytest.raises(FailedError) as error:
        store.put_file(tmp_path / "nothing")
    assert "nothing" in str(error.value) and "\n" not in str(error.value)


def test_a_check_leaves_nothing(store: Store) -> None:
    store.check()
    assert list(store.list()) == []


def test_an_address_serves_the_object_itself(store: Store, written: Written) -> None:
    store.put_file(written(CONTENT))
    url = store.url(SHA256, file_name="pass-1-rough.nc", media_type="text/plain")
    path = store.path(SHA256)
    assert (url is None) != (path is None)
    if url is not None:
        answer = httpx.get(url, headers={"Range": "bytes=256-511"}, trust_env=False, timeout=PATIENCE_S)
        assert (answer.status_code, answer.content) == (206, CONTENT[256:512])
    if path is not None:
        assert path.read_bytes() == CONTENT
