"""The files of this program: they appear complete or not at all, and only its own account can read them (folders 0700,
files 0600, under any umask). Also the lock that lets only one server use a data folder; it always ends with its holder.

Only the standard library: the supervisor and the command line use it before anything else is imported.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, BinaryIO

from service.errors import FailedError, InputError, sentence_of_os_error

_OTHERS = 0o077
# Files that say that a folder is a server's, a worker's or an agent's.
_DATA = ("serve.lock", "worker.lock", "lock", "token", "causticmill.sqlite", "settings.env")
_LOCK = "serve.lock"


@contextlib.contextmanager
def open_whole(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Open a file that gets its name once the `with` block has succeeded and its bytes are on disk; it replaces an
    existing one. OSError; if the block or the disk fails, nothing is left.

    mode : of the file, less the umask
    """
    hidden = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with os.fdopen(os.open(hidden, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        hidden.replace(path)
    except BaseException:
        hidden.unlink(missing_ok=True)
        raise


def write_whole(path: Path, text: str, mode: int = 0o666) -> None:
    """Write a file as a whole, in UTF-8. OSError."""
    with open_whole(path, mode) as file:
        file.write(text.encode())


def keep_private(folder: Path) -> Path:
    """Make a data folder if necessary, and make it private, as well as all files that this process and its children
    create from now on. FailedError, one line, if that fails.
    """
    os.umask(_OTHERS)
    try:
        make_private(folder, holding=_DATA)
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot use the data folder")) from None
    return folder


def make_private(folder: Path, *, holding: Sequence[str] = ()) -> None:
    """Make a folder if necessary and make it private, with all its contents if others could read it until now. OSError.

    No one else can reach the contents of a private folder, so one that is already private is not searched.
    holding : a folder that a person has named must contain one of these files or be empty: a home, or the whole
              computer, is not ours to close
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not folder.stat().st_mode & _OTHERS:
        return
    held = {path.name: path for path in folder.iterdir() if path.name != "lost+found"}
    if holding and held and not any(name in held and stat.S_ISREG(held[name].lstat().st_mode) for name in holding):
        raise OSError(
            errno.EOPNOTSUPP, "it is open to others and holds other things: give a folder of its own", str(folder)
        )
    try:
        folder.chmod(0o700)
    except PermissionError:
        # another number than EPERM, for which the system's own message would be shown
        words = "others may enter it, and it is not ours to close; say `chmod 700` as its owner, or give a folder in it"
        raise OSError(errno.EOPNOTSUPP, words, str(folder)) from None
    for below, folders, files in os.walk(folder):
        for name in (*folders, *files):
            _close(Path(below) / name)


def forget_oldest(folder: Path, most_bytes: int) -> None:
    """Keep a folder of results small: delete the least recently used first, but never the last two."""
    with contextlib.suppress(OSError):
        files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime)
        excess = sum(file.stat().st_size for file in files) - most_bytes
        for file in files[:-2]:
            if excess <= 0:
                break
            excess -= file.stat().st_size
            file.unlink(missing_ok=True)


def _close(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
        if not stat.S_ISLNK(mode) and mode & _OTHERS:
            path.chmod(stat.S_IMODE(mode) & ~_OTHERS)
    except (FileNotFoundError, PermissionError):  # deleted meanwhile, or another account's and now out of reach
        pass


def lock_folder(folder: Path, *, doing: str = "served") -> IO[str]:
    """Lock a file, which the caller keeps open; make the folder if necessary. InputError if another process has the
    lock.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"--data {folder} is a file; allowed: a folder")
        keep_private(folder)
        file = (folder / _LOCK).open("a+", encoding="ascii")
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot use the data folder")) from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        holder = file.read(60).strip() or "another process"
        file.close()
        raise InputError(f"--data {folder} is in use by {holder}; stop that first, or give another folder") from None
    except OSError as error:
        file.close()
        raise FailedError(sentence_of_os_error(error, doing=f"cannot lock the data folder {folder}")) from None
    file.truncate(0)
    file.write(f"process {os.getpid()} ({doing})\n")
    file.flush()
    return file
