"""One server per data folder: a lock that ends with its holder, however that ends."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO

from service.errors import FailedError, InputError, sentence_of_os_error
from service.processes.private import keep_private

_NAME = "serve.lock"


def lock_folder(folder: Path, *, doing: str = "served") -> IO[str]:
    """Lock a file, to be kept open; the folder is made if need be. InputError where another process has it."""
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"--data {folder} is a file; allowed: a folder")
        keep_private(folder)
        file = (folder / _NAME).open("a+", encoding="ascii")
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
