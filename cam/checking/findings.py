"""Findings of the check, gathered move by move: how many, the first and the worst of each kind, as one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from phrases.phrase import Phrase


@dataclass(slots=True, kw_only=True)
class Finding:
    """One kind of fault. `says` puts (value, allowed) into words: "gouges the lens by 2.1 µm (allowed 1 µm)"."""

    says: Callable[[float], Phrase]
    count: int = 0
    first_line: int = 0
    worst_line: int = 0
    worst: float = 0.0
    x_mm: float = float("nan")
    y_mm: float = float("nan")

    def note(self, value: float, line: int, x_mm: float, y_mm: float, *, count: int = 1) -> None:
        """Note one offending move, or the worst of `count` of them."""
        if self.count == 0:
            self.first_line = line
        if self.count == 0 or value > self.worst:
            self.worst, self.worst_line, self.x_mm, self.y_mm = value, line, x_mm, y_mm
        self.count += count

    def note_moves(self, guilty: np.ndarray, values: np.ndarray, lines: np.ndarray, places: np.ndarray) -> None:
        """Note all offending moves of a batch: guilty (n,) bool, values (n,), lines (n,), places (n, 2 or 3)."""
        where = np.flatnonzero(guilty)
        if where.size == 0:
            return
        if self.count == 0:
            self.first_line = int(lines[where[0]])
            first = self.first_line
        else:
            first = self.first_line
        k = where[values[where].argmax()]
        self.note(float(values[k]), int(lines[k]), float(places[k][0]), float(places[k][1]), count=where.size)
        self.first_line = first

    @property
    def sentences(self) -> list[Phrase]:
        if self.count == 0:
            return []
        words = Phrase(
            "line {line} at X{x_mm:.3f} Y{y_mm:.3f} {fault}",
            line=self.worst_line,
            x_mm=self.x_mm,
            y_mm=self.y_mm,
            fault=self.says(self.worst),
        )
        if self.count > 1:
            words = Phrase(
                "{fault}; the worst of {count} lines, the first of them is line {line}",
                fault=words,
                count=self.count,
                line=self.first_line,
            )
        return [words]
