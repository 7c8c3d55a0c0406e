"""What a stage's process says, kept short: a stage that says the same thing for hours must not fill the disk.

The process appends to the file by itself, so the worker cannot shorten it without losing words just written: now and
then it gives the disk blocks of the middle back, and takes the middle out when nobody writes any more. What was said
first and what was said last is what tells why a stage went wrong.
"""

from __future__ import annotations

from pathlib import Path

from service.processes.linux import give_back_blocks

MOST_BYTES = 1_000_000
HALF = MOST_BYTES // 2
CUT = b"\n... (cut here: the stage said more than 1 MB) ...\n"


class StageLog:
    """The file must be there."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._freed = HALF

    def look(self) -> None:
        """Look while it is being written."""
        end = self._path.stat().st_size - HALF
        if end > self._freed + MOST_BYTES:
            give_back_blocks(self._path, self._freed, end - self._freed)
            self._freed = end

    def end(self) -> None:
        """End it, as nobody writes any more: the first half, and the last."""
        size = self._path.stat().st_size
        if size > MOST_BYTES:
            with self._path.open("r+b") as file:
                file.seek(size - HALF)
                rest = file.read()
                file.truncate(HALF)
                file.seek(HALF)
                file.write(CUT + rest)
