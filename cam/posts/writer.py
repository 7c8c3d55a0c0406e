"""What turns the paths of one program into its text."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator

from cam.moves import Path
from cam.posts.setup import ProgramSetup


class Writer(ABC):
    """The modal state of one program while it is written: start, then paths, then end."""

    @abstractmethod
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

    @abstractmethod
    def write(self, path: Path) -> Iterator[bytes]:
        """Yield blocks of one path, in pieces."""

    @abstractmethod
    def end(self, *, safe_z_mm: float, setup: ProgramSetup | None = None) -> bytes:
        """Write everything after the last move: up, all off, end."""
