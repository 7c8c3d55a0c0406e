"""What turns the paths of one program into its text: the writer of each family of dialects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

from cam.moves import Path
from cam.posts.dialects import Dialect
from cam.posts.gcode_writer import ProgramWriter
from cam.posts.post import Post, RmlPost
from cam.posts.rml_writer import RmlWriter
from cam.posts.setup import ProgramSetup


class Writer(Protocol):
    """The modal state of one program while it is written: start, then paths, then end."""

    def start(
        self,
        remarks: tuple[str, ...],
        *,
        rpm: float,
        safe_z_mm: float,
        program: int = 1,
        setup: ProgramSetup | None = None,
        trace: Iterable[Path] = (),
    ) -> bytes:
        """Write all before the first cut: modes, safe height, the trace in the air, spindle up to speed, what `setup`
        switches on. program: number, from 1; trace: paths run before the spindle turns, where the control allows that.
        """

    def write(self, path: Path) -> Iterator[bytes]:
        """Yield blocks of one path, in pieces."""

    def end(self, *, safe_z_mm: float, setup: ProgramSetup | None = None) -> bytes:
        """Write everything after the last move: up, all off, end."""


def create_writer(dialect: Dialect) -> Writer:
    """Return the writer of one program in a dialect."""
    match dialect:
        case Post():
            return ProgramWriter(dialect)
        case RmlPost():
            return RmlWriter(dialect)
