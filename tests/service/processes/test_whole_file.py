"""A file that this program replaces is the old one or the new one, whatever happens between."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from service.processes.whole_file import open_whole, write_whole

SERVICE = Path(__file__).parents[3] / "service"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, OSError])
def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    kept = tmp_path / "kept"
    kept.write_text("old")
    with pytest.raises(error), open_whole(kept) as file:
        file.write(b"new")
        raise error
    assert kept.read_text() == "old" and list(tmp_path.iterdir()) == [kept]


def test_the_name_is_taken_once_the_bytes_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, seen = tmp_path / "kept", list[str]()
    kept.write_text("old")
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda descriptor: (sync(descriptor), seen.append(kept.read_text())))
    write_whole(kept, "new")
    assert (seen, kept.read_text(), list(tmp_path.iterdir())) == (["old"], "new", [kept])


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_the_new_file_has_the_mode_asked_for(tmp_path: Path, mode: int) -> None:
    kept = tmp_path / "kept"
    kept.write_text("old")
    kept.chmod(0o666)
    before = os.umask(0o022)
    try:
        write_whole(kept, "new", mode)
    finally:
        os.umask(before)
    assert kept.stat().st_mode & 0o777 == mode


def test_no_other_module_replaces_files_in_its_own_way() -> None:
    """Beside it sync: the store and what it is filled from, whose names are those of their content."""
    found = {path.relative_to(SERVICE).as_posix() for path in SERVICE.rglob("*.py") if "os.fsync(" in path.read_text()}
    by_content = {"store/local.py", "client/download.py", "milling/agent/programs.py", "server/database/backup.py"}
    assert found == by_content | {"processes/whole_file.py"}
