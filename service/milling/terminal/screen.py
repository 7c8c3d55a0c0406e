"""How a run looks: a live panel on a terminal, a plain line every few seconds otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from service.errors import printable
from service.wording import duration

_PLAIN_EVERY_S = 5.0
_STATE_COLOURS = {
    "run": "green",
    "idle": "cyan",
    "holding": "yellow",
    "held": "yellow",
    "door": "yellow",
    "alarm": "bold red",
    "disconnected": "bold red",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamView:
    """All that a screen shows of a run. Positions in mm in the work frame; None = not known, or of no interest."""

    state: str
    detail: str = ""
    run_state: str = ""
    line: int = 0
    executed_line: int = 0
    total_lines: int = 0
    time_left_s: float | None = None
    position_mm: tuple[float, float, float] | None = None
    buffer: str = ""
    feed_mm_per_min: float | None = None
    spindle: str = ""
    overrides: tuple[int, int, int] = (100, 100, 100)
    protections: tuple[str, ...] = ()
    question: str = ""

    @property
    def over(self) -> bool:
        """Nothing more is to come of this run."""
        return self.run_state in ("finished", "aborted", "interrupted")

    @property
    def shown_state(self) -> str:
        """The mill's state; in a run, the moments in which its buffer is empty (a dwell, a short of lines) are run."""
        return "run" if self.state == "idle" and self.run_state in ("running", "recovering") else self.state

    @property
    def share(self) -> float:
        """How much of the program is certainly cut, 0 to 1, by lines."""
        return min(1.0, self.executed_line / self.total_lines) if self.total_lines else 0.0


class Screen(Protocol):
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None: ...
    def show(self, view: StreamView) -> None: ...
    def say(self, line: str) -> None: ...


class PlainScreen:
    """One line when the state changes, and one every few seconds."""

    def __init__(self, out: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._out = out if out is not None else sys.stdout
        self._clock = clock
        self._shown: tuple[str, str] = ("", "")
        self._shown_s = float("-inf")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None: ...

    def show(self, view: StreamView) -> None:
        now, state = self._clock(), (view.shown_state, view.run_state)
        if state == self._shown and now - self._shown_s < _PLAIN_EVERY_S:
            return
        self._shown, self._shown_s = state, now
        self.say(one_line(view))

    def say(self, line: str) -> None:
        print(printable(line), file=self._out, flush=True)


class LiveScreen:
    """The panel. Drawn only when asked to: the caller decides how often."""

    def __init__(self, program: str, console: Console | None = None) -> None:
        self._program = program
        self._console = console or Console()
        self._live = Live(console=self._console, auto_refresh=False, transient=False, redirect_stdout=False)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._live.stop()

    def show(self, view: StreamView) -> None:
        self._live.update(panel(self._program, view), refresh=True)

    def say(self, line: str) -> None:
        self._live.console.print(Text(printable(line)))


def panel(program: str, view: StreamView) -> Panel:
    """Return the whole display as one renderable: always the same number of rows, so that nothing jumps."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True, min_width=len("protection"))
    table.add_column(no_wrap=True, overflow="ellipsis")
    state = Text(view.shown_state.upper(), style=_STATE_COLOURS.get(view.shown_state, "bold"))
    table.add_row("mill", state.append(f"  {printable(view.detail)}" if view.detail else "", style="default"))
    table.add_row("line", f"{view.line:,} of {view.total_lines:,} sent, {view.executed_line:,} cut for certain")
    table.add_row("time left", "" if view.over else duration(view.time_left_s))
    table.add_row("position", position_words(view.position_mm))
    feed = "unknown" if view.feed_mm_per_min is None else f"{view.feed_mm_per_min:.0f} mm/min"
    table.add_row("feed", f"{feed}, spindle {view.spindle or 'unknown'}")
    table.add_row("overrides", override_words(view.overrides))
    table.add_row("buffer", view.buffer or "unknown")
    table.add_row("protection", Text(printable("; ".join(view.protections) or "none")))
    bar = Table.grid(expand=True)
    bar.add_column(ratio=1)
    bar.add_column(width=8, justify="right")
    bar.add_row(ProgressBar(total=1.0, completed=view.share), f"{100 * view.share:.1f} %")
    keys = Text(view.question, style="bold yellow", no_wrap=True, overflow="ellipsis")
    return Panel(Group(table, bar, keys), title=Text(printable(program)), title_align="left")


def one_line(view: StreamView) -> str:
    """Return the same as one line of a log."""
    parts = [
        f"{view.shown_state}{f' ({view.detail})' if view.detail else ''}",
        f"line {view.line:,} of {view.total_lines:,}",
        f"cut {100 * view.share:.1f} %",
        position_words(view.position_mm),
    ]
    if not view.over:
        parts.insert(3, f"time left {duration(view.time_left_s)}")
    if view.feed_mm_per_min is not None:
        parts.append(f"F{view.feed_mm_per_min:.0f}")
    if view.buffer:
        parts.append(f"buffer {view.buffer}")
    if view.overrides != (100, 100, 100):
        parts.append(f"overrides {override_words(view.overrides)}")
    return ", ".join(parts)


def position_words(position_mm: tuple[float, float, float] | None) -> str:
    if position_mm is None:
        return "position unknown"
    x, y, z = position_mm
    return f"X{x:.3f} Y{y:.3f} Z{z:.3f}"


def override_words(overrides: tuple[int, int, int]) -> str:
    feed, rapid, spindle = overrides
    return f"feed {feed} %, rapid {rapid} %, spindle {spindle} %"
