"""The store in a folder: crashes, full disks, later writes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from service.errors import FailedError
from service.store.base import MissingObjectError
from service.store.local import LocalStore

Written = Callable[[bytes], Path]

_SLOW_COPY = """
import os, sys, time
from pathlib import Path
from service.store import local

source = Path(sys.argv[1])
slow = local._copy
def copy(source, target):
    sha256 = slow(source, target)
    print("copied", flush=True)
    time.sleep(600)
    return sha256
local._copy = copy
store = local.LocalStore(Path(sys.argv[2]))
store._may_be_linked = lambda facts: False
store.put_file(source)
"""


def test_a_file_beside_the_store_is_linked_and_read_only(tmp_path: Path, written: Written) -> None:
    store, path = LocalStore(tmp_path / "objects"), written(b"lens")
    stored = store.put_file(path)
    assert path.stat().st_ino == store.path(stored.sha256).stat().st_ino  # type: ignore[union-attr]
    assert path.stat().st_mode & 0o777 == 0o400


def test_a_file_that_grows_meanwhile_is_refused(
    tmp_path: Path, written: Written, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, path = LocalStore(tmp_path / "objects"), written(b"half")
    writer = path.open("ab", buffering=0)
    fchmod = os.fchmod
    monkeypatch.setattr(os, "fchmod", lambda *given: (fchmod(*given), writer.write(b" more")))
    with writer, pytest.raises(FailedError, match="still being written"):
        store.put_file(path)
    assert list(store.list()) == []


def test_copies_where_no_link_can_be(tmp_path: Path, written: Written, monkeypatch: pytest.MonkeyPatch) -> None:
    store, path = LocalStore(tmp_path / "objects"), written(b"lens" * 1000)
    monkeypatch.setattr(LocalStore, "_may_be_linked", lambda *_: False)
    stored = store.put_file(path)
    there = store.path(stored.sha256)
    assert there is not None and there.stat().st_ino != path.stat().st_ino
    assert there.stat().st_mode & 0o777 == 0o400
    assert list((tmp_path / "objects/incoming").iterdir()) == []


def test_a_killed_writer_leaves_no_object_and_its_rest_is_swept(tmp_path: Path, written: Written) -> None:
    path, root = written(b"lens" * 100_000), tmp_path / "objects"
    writer = subprocess.Popen([sys.executable, "-c", _SLOW_COPY, path, root], stdout=subprocess.PIPE)
    with writer:
        assert writer.stdout is not None and writer.stdout.readline() == b"copied\n"
        store = LocalStore(root)
        assert len(list((root / "incoming").iterdir())) == 1, "of a writer that lives nothing is swept"
        writer.send_signal(signal.SIGKILL)
    assert list(store.list()) == []
    LocalStore(root)
    assert list((root / "incoming").iterdir()) == []


def test_a_damaged_object_is_replaced_by_storing_it_again(tmp_path: Path, written: Written) -> None:
    store = LocalStore(tmp_path / "objects")
    stored = store.put_file(written(b"lens"))
    place = store.path(stored.sha256)
    assert place is not None
    place.unlink()
    place.write_bytes(b"")
    assert store.put_file(written(b"lens")).bytes == 4
    assert b"".join(store.open_range(stored.sha256)) == b"lens"


def test_many_writers_of_one_content(tmp_path: Path, written: Written) -> None:
    store, paths = LocalStore(tmp_path / "objects"), [written(b"lens" * 1000) for _ in range(16)]
    threads = [threading.Thread(target=store.put_file, args=(path,)) for path in paths]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(list(store.list())) == 1


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path, written: Written) -> None:
    """A limit on the size of files stands for the full disk: the same place refuses, with another reason."""
    path = written(b"x" * 3_000_000)
    words = (
        "import resource, signal, sys; from pathlib import Path; from service.store.local import LocalStore;"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20));"
        "store = LocalStore(Path(sys.argv[2])); store._may_be_linked = lambda facts: False;"
        "store.put_file(Path(sys.argv[1]))"
    )
    ended = subprocess.run([sys.executable, "-c", words, path, tmp_path / "objects"], capture_output=True, text=True)
    assert "FailedError: cannot store" in ended.stderr.splitlines()[-1]
    store = LocalStore(tmp_path / "objects")
    assert list(store.list()) == []
    assert list((tmp_path / "objects/incoming").iterdir()) == []


def test_a_fetched_file_survives_deletion(tmp_path: Path, written: Written) -> None:
    store = LocalStore(tmp_path / "objects")
    stored = store.put_file(written(b"lens"))
    store.fetch(stored.sha256, tmp_path / "lens")
    store.delete(stored.sha256)
    assert (tmp_path / "lens").read_bytes() == b"lens"
    with pytest.raises(MissingObjectError):
        store.fetch(stored.sha256, tmp_path / "again")


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FailedError, match="cannot use the artifact store"):
        LocalStore(tmp_path / "file" / "objects")
