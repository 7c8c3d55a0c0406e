"""Which store the settings ask for, and what is refused."""

from __future__ import annotations

import builtins
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.errors import FailedError, InputError
from service.settings import ServerSettings
from service.store.local import LocalStore
from service.store.opening import open_store
from service.store.s3 import S3Store

POSTGRES = "postgresql://localhost/causticmill"


def test_by_default_objects_lie_beside_the_database(tmp_path: Path) -> None:
    store = open_store(ServerSettings(data=tmp_path))
    assert isinstance(store, LocalStore)
    assert store.root == tmp_path / "objects" and not store.shared


def test_a_shared_folder_needs_the_persons_word(tmp_path: Path) -> None:
    url = (tmp_path / "a%20b").as_uri().replace("%25", "%")
    with pytest.raises(InputError, match="STORE_IS_SHARED"):
        open_store(ServerSettings(data=tmp_path, store_url=url, database_url=POSTGRES))
    store = open_store(ServerSettings(data=tmp_path, store_url=url, database_url=POSTGRES, store_is_shared=True))
    assert isinstance(store, LocalStore) and store.shared
    assert store.root == tmp_path / "a b"


def test_a_farm_with_a_local_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="DATABASE_URL"):
        open_store(ServerSettings(data=tmp_path, database_url=POSTGRES))


@pytest.mark.parametrize(
    "url", ["folder", "file://other/folder", "file:relative", "s3://", "gs://bucket", "http://x/y"]
)
def test_what_is_no_store_is_refused_by_name(tmp_path: Path, url: str) -> None:
    with pytest.raises(InputError, match="CAUSTICMILL_STORE_URL"):
        open_store(ServerSettings(data=tmp_path, store_url=url))


def test_a_bucket_is_shared_and_a_missing_one_is_told(tmp_path: Path, s3_address: str) -> None:
    store = open_store(ServerSettings(data=tmp_path, store_url="s3://no-such-bucket/here", database_url=POSTGRES))
    assert isinstance(store, S3Store) and store.shared
    with pytest.raises(FailedError, match=r"s3://no-such-bucket") as error:
        store.check()
    assert "\n" not in str(error.value)


def test_an_unreachable_server_is_one_line(tmp_path: Path, s3_address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    store = open_store(ServerSettings(data=tmp_path, store_url="s3://bucket"))
    with pytest.raises(FailedError, match="s3://bucket") as error:
        store.check()
    assert "\n" not in str(error.value)


def test_plain_http_is_for_loopback_only(tmp_path: Path, s3_address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://192.0.2.1:9000")
    with pytest.raises((InputError, FailedError), match=r"(?i)http"):
        open_store(ServerSettings(data=tmp_path, store_url="s3://bucket")).check()


def test_without_the_extra_the_person_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_obstore(name: str, *given: Any, **named: Any) -> Any:
        if name.startswith("obstore"):
            raise ImportError(name)
        return real(name, *given, **named)

    monkeypatch.setattr(builtins, "__import__", without_obstore)
    with pytest.raises(InputError, match=r"causticmill\[s3\]"):
        open_store(ServerSettings(data=tmp_path, store_url="s3://bucket"))


_UPLOAD = """
import sys
from pathlib import Path
from service.settings import ServerSettings
from service.store.opening import open_store
from tests_memory import high_water_mb

store = open_store(ServerSettings(data=Path(sys.argv[1]), store_url=sys.argv[2]))
small = store.put_file(Path(sys.argv[3]))
b"".join(store.open_range(small.sha256))
before = high_water_mb()
large = store.put_file(Path(sys.argv[4]))
print(sum(map(len, store.open_range(large.sha256))), high_water_mb() - before)
"""
_HIGH_WATER = """
def high_water_mb():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM"))
"""


@pytest.mark.thorough
def test_memory_does_not_grow_with_the_object(tmp_path: Path, s3_urls: Iterator[str]) -> None:
    """200 MB up and down: what grows is the parts in flight (4 of 8 MB), not the object."""
    (tmp_path / "tests_memory.py").write_text(_HIGH_WATER)
    for name, megabytes in (("small", 32), ("large", 200)):
        with (tmp_path / name).open("wb") as file:
            for number in range(megabytes):
                file.write(number.to_bytes(4, "big") * (1 << 18))
    arguments = [tmp_path, next(s3_urls), tmp_path / "small", tmp_path / "large"]
    said = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{_UPLOAD}", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert int(said[0]) == 200 << 20
    assert float(said[1]) < 60


def test_a_database_of_another_kind_is_named_as_such(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"CAUSTICMILL_DATABASE_URL: allowed: postgresql://"):
        open_store(ServerSettings(data=tmp_path, database_url="mysql://me:secret@db/x"))


def test_missing_credentials_are_named() -> None:
    """What the library says then is about an address that asks the cloud who this computer is."""
    from service.store.s3 import _first_words

    asked = "Generic S3 error: Error performing PUT http://169.254.169.254/latest/api/token in 7.5ms - refused"
    assert _first_words(Exception(asked)) == "no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    tries = "in 67.9ms, after 5 retries, max_retries: 5, retry_timeout: 20s "
    lost = f"Generic S3 error: Error performing PUT http://s3/b/k {tries} - HTTP error: no route"
    assert _first_words(Exception(lost)) == "Error performing PUT http://s3/b/k - HTTP error: no route"
