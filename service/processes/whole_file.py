"""Files that appear whole or not at all. Only the standard library: every process writes some."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def open_whole(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Open a file that takes its name once the block has ended well and its bytes are on the disk, in place of one
    that is there. OSError; where the block or the disk fails nothing is left.

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
