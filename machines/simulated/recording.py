"""The path that was really cut, in physical coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

Triple = tuple[float, float, float]


class CutSegment(NamedTuple):
    """One executed block, or the part of it between two stops.

    start, end : mm, physical: relative to where the tool stood at the first power-up, whatever MPos says
    rapid      : G0 (homing and jogs count as rapid: they are not part of a program)
    feed       : programmed feed in mm/min as it was planned (before overrides)
    spindle_on : at the end of this segment
    line       : count of lines the firmware has received, of the line this block came from (N word if one was given)
    at_s       : simulated time of its end
    whole      : the block was executed to its end
    kind       : "program", "jog", "probe", "homing" or "slip" (steps lost in a stop without deceleration)
    """

    start: Triple
    end: Triple
    rapid: bool
    feed: float
    spindle_on: bool
    line: int
    at_s: float
    whole: bool
    kind: str


class Recording:
    """Collects cut segments in a list, and hands each to `on_block` if there is one (for long soaks: keep=False)."""

    def __init__(self, on_block: Callable[[CutSegment], None] | None = None, *, keep: bool = True) -> None:
        self.on_block = on_block
        self.keep = keep
        self.segments: list[CutSegment] = []
        self.count = 0

    def add(self, segment: CutSegment) -> None:
        self.count += 1
        if self.keep:
            self.segments.append(segment)
        if self.on_block is not None:
            self.on_block(segment)

    def cuts(self) -> list[CutSegment]:
        """Return program motion at feed, in order."""
        return [s for s in self.segments if s.kind == "program" and not s.rapid]
