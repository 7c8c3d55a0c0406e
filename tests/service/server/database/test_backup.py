"""Backup and restore of a data folder: consistent while it is written to, whole or refused."""

from __future__ import annotations

import contextlib
import hashlib
import io
import sqlite3
import tarfile
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from service.cli.main import run
from service.errors import FailedError, InputError
from service.server.database.backup import back_up, restore_backup, verify_store
from service.server.database.pairing import PairingBook
from service.server.database.schema import open_database
from service.server.database.tokens import TokenBook
from service.server.pairing_code import new_offer
from service.settings import ServerSettings
from service.store.local import LocalStore
from tests.waiting import PATIENCE_S


@pytest.fixture
def server(tmp_path: Path) -> ServerSettings:
    """A data folder with two databases in WAL mode and three objects; each row of the one names an object."""
    settings = ServerSettings(data=tmp_path / "data")
    store = LocalStore(settings.data / "objects")
    for name in ("engine.sqlite", "causticmill.sqlite"):
        with sqlite3.connect(settings.data / name) as database:
            database.execute("PRAGMA journal_mode = WAL")
            database.execute("CREATE TABLE things (sha256 TEXT)")
    for content in (b"one", b"two", b"three" * 500_000):
        add(settings, store, content)
    return settings


def add(settings: ServerSettings, store: LocalStore, content: bytes) -> None:
    path = settings.data / f"upload-{threading.get_ident()}"
    path.write_bytes(content)
    sha256 = store.put_file(path).sha256
    path.unlink()
    with sqlite3.connect(settings.data / "causticmill.sqlite", timeout=PATIENCE_S) as database:
        database.execute("INSERT INTO things VALUES (?)", (sha256,))
    database.close()


def named(data: Path) -> set[str]:
    with contextlib.closing(sqlite3.connect(data / "causticmill.sqlite")) as database:
        return {row[0] for row in database.execute("SELECT sha256 FROM things")}


def held(data: Path) -> set[str]:
    return {stored.sha256 for stored in LocalStore(data / "objects").list()}


def test_round_trip(server: ServerSettings, tmp_path: Path) -> None:
    back_up(server, tmp_path / "backup.tar")
    assert (tmp_path / "backup.tar").stat().st_mode & 0o777 == 0o600
    again = ServerSettings(data=tmp_path / "again")
    restore_backup(tmp_path / "backup.tar", again)
    assert named(again.data) == named(server.data) == held(again.data)
    assert verify_store(again)
    assert {path.name for path in again.data.iterdir()} == {
        "engine.sqlite", "causticmill.sqlite", "objects", "serve.lock"
    }  # fmt: skip


def test_every_object_that_is_named_is_there_however_much_is_written_meanwhile(
    server: ServerSettings, tmp_path: Path
) -> None:
    end = threading.Event()

    def write() -> None:
        store, number = LocalStore(server.data / "objects"), 0
        while not end.is_set():
            add(server, store, f"content {number}".encode())
            number += 1

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for number in range(3):
            back_up(server, tmp_path / f"{number}.tar")
    finally:
        end.set()
        writer.join()
    for number in range(3):
        again = ServerSettings(data=tmp_path / f"again-{number}")
        restore_backup(tmp_path / f"{number}.tar", again)
        assert named(again.data) <= held(again.data)


@pytest.mark.parametrize("keep", [False, True])
def test_a_restored_backup_revives_no_revoked_token(tmp_path: Path, keep: bool) -> None:
    """It cannot know which were revoked after it was made; so none opens anything, unless a person says otherwise."""
    server, again = ServerSettings(data=tmp_path / "data"), ServerSettings(data=tmp_path / "again")
    database = open_database(server, migrate=True)
    book, offer = TokenBook(database), new_offer()
    made, secret = book.create("lost laptop", ["machine:run"])
    PairingBook(database, book).offer(offer)
    LocalStore(server.data / "objects")
    back_up(server, tmp_path / "backup.tar")
    book.revoke(made.id)
    database.dispose()
    words = " ".join(restore_backup(tmp_path / "backup.tar", again, keep_tokens=keep))
    assert not (again.data / "causticmill.sqlite-wal").exists()
    database = open_database(again)
    book = TokenBook(database)
    assert (book.find(secret) is not None) is keep and book.has_ever_had_any(), "nobody becomes anonymous by it"
    assert PairingBook(database, book).is_live(offer) is keep
    database.dispose()
    assert f"token {'list' if keep else 'create NAME --scope ...'} --data {again.data}" in words
    assert ("revoked since opens again" if keep else "1 of which were live") in words


def test_a_folder_that_holds_something_is_not_touched(server: ServerSettings, tmp_path: Path) -> None:
    back_up(server, tmp_path / "backup.tar")
    before = held(server.data)
    with pytest.raises(InputError, match="not empty"):
        restore_backup(tmp_path / "backup.tar", server)
    assert held(server.data) == before


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def without_end(content: bytes) -> bytes:
    """Without its last member, but well closed: only the missing list tells."""
    new = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(content)) as old, tarfile.open(fileobj=new, mode="w") as tar:
        for member in old.getmembers()[:-1]:
            tar.addfile(member, old.extractfile(member))
    return new.getvalue()


def without_an_object(content: bytes) -> bytes:
    new = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(content)) as old, tarfile.open(fileobj=new, mode="w") as tar:
        first = next(member for member in old.getmembers() if member.name.startswith("objects"))
        for member in old.getmembers():
            if member.name != first.name:
                tar.addfile(member, old.extractfile(member))
    return new.getvalue()


def altered(content: bytes) -> bytes:
    at = content.index(b"threethree") + 600
    return content[:at] + b"X" + content[at + 1 :]


def altered_database(content: bytes) -> bytes:
    at = content.index(b"CREATE TABLE things")
    return content[:at] + b"X" + content[at + 1 :]


@pytest.mark.parametrize(
    "harm", [cut, without_end, without_an_object, altered, altered_database, lambda _: b"", lambda _: b"x" * 9999]
)
def test_what_is_not_whole_is_refused_and_leaves_an_empty_folder(
    server: ServerSettings, tmp_path: Path, harm: Callable[[bytes], bytes]
) -> None:
    back_up(server, tmp_path / "backup.tar")
    (tmp_path / "harmed.tar").write_bytes(harm((tmp_path / "backup.tar").read_bytes()))
    with pytest.raises(FailedError):
        restore_backup(tmp_path / "harmed.tar", ServerSettings(data=tmp_path / "again"))
    assert list((tmp_path / "again").iterdir()) == []


@pytest.mark.parametrize(
    "name", ["../outside", "/tmp/outside", "objects/../x", "agents/grbl/journal", "objects/ab/short"]
)
def test_nothing_else_comes_out_of_a_backup(tmp_path: Path, name: str) -> None:
    with tarfile.open(tmp_path / "evil.tar", "w") as tar:
        member = tarfile.TarInfo(name)
        member.size = 4
        tar.addfile(member, io.BytesIO(b"evil"))
    with pytest.raises(InputError):
        restore_backup(tmp_path / "evil.tar", ServerSettings(data=tmp_path / "again"))
    assert {path.name for path in tmp_path.iterdir()} == {"evil.tar", "again"}


def test_a_damaged_object_is_named_and_the_rest_is_saved(server: ServerSettings, tmp_path: Path) -> None:
    sha256 = hashlib.sha256(b"one").hexdigest()
    place = LocalStore(server.data / "objects").path(sha256)
    assert place is not None
    place.chmod(0o600)
    place.write_bytes(b"0ne")
    with pytest.raises(FailedError, match=sha256):
        verify_store(server)
    with pytest.raises(FailedError, match=sha256):
        back_up(server, tmp_path / "backup.tar")
    lines = restore_backup(tmp_path / "backup.tar", ServerSettings(data=tmp_path / "again"))
    assert sha256 in lines[-1]
    assert held(tmp_path / "again") == named(server.data) - {sha256}


def test_a_backup_is_never_written_over(server: ServerSettings, tmp_path: Path) -> None:
    (tmp_path / "backup.tar").write_text("older")
    with pytest.raises(InputError, match="there already"):
        back_up(server, tmp_path / "backup.tar")
    assert (tmp_path / "backup.tar").read_text() == "older"


def test_a_folder_without_a_server_has_no_backup(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["service", "backup", str(tmp_path / "backup.tar"), "--data", str(tmp_path / "none")]) == 2
    assert "error: --data" in capsys.readouterr().err
    assert not (tmp_path / "backup.tar").exists() and not (tmp_path / "none").exists()


def test_of_a_farm_the_store_is_saved_and_the_rest_is_said(server: ServerSettings, tmp_path: Path) -> None:
    farm = ServerSettings(
        data=tmp_path / "host",
        database_url="postgresql://localhost/causticmill",
        store_url=(server.data / "objects").as_uri(),
        store_is_shared=True,
    )
    farm.data.mkdir()
    lines = back_up(farm, tmp_path / "backup.tar")
    assert "pg_dump" in lines[-1]
    again = farm.model_copy(update={"data": tmp_path / "again", "store_url": (tmp_path / "store").as_uri()})
    assert "pg_restore" in restore_backup(tmp_path / "backup.tar", again)[-1]
    assert {stored.sha256 for stored in LocalStore(tmp_path / "store").list()} == held(server.data)
