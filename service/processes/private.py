"""What this program keeps is for its own account alone: folders 0700, files 0600, whatever umask it is started with.

Only the standard library: the supervisor and the command line use it before anything else is imported.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Sequence
from pathlib import Path

from service.errors import FailedError, sentence_of_os_error

_OTHERS = 0o077
# Files that say that a folder is a server's, a worker's or an agent's.
_DATA = ("serve.lock", "worker.lock", "lock", "token", "causticmill.sqlite", "settings.env")


def keep_private(folder: Path) -> Path:
    """Make a data folder if need be, close it to others, and all that this process and its children make from now on.

    FailedError, one line, where that cannot be.
    """
    os.umask(_OTHERS)
    try:
        make_private(folder, holding=_DATA)
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot use the data folder")) from None
    return folder


def make_private(folder: Path, *, holding: Sequence[str] = ()) -> None:
    """Make a folder if need be and close it to others; one that was open until now with all that is in it. OSError.

    Once it is closed nobody else reaches what is in it: a folder that is closed already is not walked through.
    holding : files of which one must be in a folder that a person has named, unless it is empty: a home, or the whole
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
        # another number than EPERM, whose words would be the system's own
        words = "others may enter it, and it is not ours to close; say `chmod 700` as its owner, or give a folder in it"
        raise OSError(errno.EOPNOTSUPP, words, str(folder)) from None
    for below, folders, files in os.walk(folder):
        for name in (*folders, *files):
            _close(Path(below) / name)


def _close(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
        if not stat.S_ISLNK(mode) and mode & _OTHERS:
            path.chmod(stat.S_IMODE(mode) & ~_OTHERS)
    except (FileNotFoundError, PermissionError):  # gone meanwhile; or another account's, and out of others' reach now
        pass
