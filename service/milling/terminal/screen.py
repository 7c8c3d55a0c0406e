"""How a run is displayed: a live panel on a terminal, otherwise a plain line every few seconds. Also what `stream`
prints before and after a run: the mill, the program, a fault and how to continue.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from machines.driver import DriverFacts, MillState, MillStatus
from machines.preflight.preflight import Preflight
from machines.profile import MachineProfile
from machines.runs import RunReport
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
        """Whether the run has ended."""
        return self.run_state in ("finished", "aborted", "interrupted")

    @property
    def shown_state(self) -> str:
        """The mill's state. During a run, idle moments with an empty buffer (a dwell, a lack of lines) count as
        "run".
        """
        return "run" if self.state == "idle" and self.run_state in ("running", "recovering") else self.state

    @property
    def share(self) -> float:
        """Share of the program's lines that are certainly cut, 0 to 1."""
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


DEFAULT_MACHINE = "grbl"
_AXES = "XYZ"
_INDENT = 12


def print_lines(lines: Iterable[str]) -> None:
    """Print `name:   words`; on a terminal no word is cut at its edge."""
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else 0
    for line in lines:
        text = printable(line)
        wrapped = (
            textwrap.wrap(
                text,
                columns,
                subsequent_indent=" " * _INDENT,
                break_long_words=False,
                break_on_hyphens=False,
                drop_whitespace=True,
                replace_whitespace=False,
            )
            if columns > 2 * _INDENT
            else [text]
        )
        print("\n".join(wrapped or [""]))
    sys.stdout.flush()


def stop_lines(heard: Sequence[signal.Signals]) -> Iterator[str]:
    """Yield lines that say how to stop a run without a keyboard. heard: the signals that stop it; may be empty."""
    commands = [f"`kill -{kind.name.removeprefix('SIG')} {os.getpid()}`" for kind in heard]
    ways = ", ".join(("Ctrl-C", *commands) if signal.SIGINT in heard else commands)
    if ways:
        yield f"to stop:    {ways}: each holds the mill, then aborts from standstill"
    else:
        yield "to stop:    only at the mill itself: the caller of this command blocks all signals"
    yield f"{'':<11} no keys are read here. The mill's own feed hold, reset and emergency stop always work"


def mill_lines(url: str, status: MillStatus, protections: tuple[str, ...], facts: DriverFacts | None) -> Iterator[str]:
    """Yield lines about the machine, its position, and how its link is protected."""
    state = f"{status.state.value}{f' ({status.detail})' if status.detail else ''}"
    yield f"mill:       {status.controller or 'unknown controller'} on {url}, {state}"
    yield from place_lines(status)
    if facts is not None:
        yield f"link:       {facts.capacity}; {facts.acknowledgement}"
        yield f"stop:       {facts.stop}"
    for number, words in enumerate(protections or ("none",)):
        yield f"{'protection:' if number == 0 else '           '} {words}"


def place_lines(status: MillStatus) -> Iterator[str]:
    """Yield lines about the mill's position and whether it can be trusted."""
    sure = "sure" if status.position_trusted else "not sure: not homed, and nobody has said that it is right"
    yield f"position:   work {position_words(status.work_mm)}, machine {position_words(status.machine_mm)}, {sure}"
    offset = "unknown" if status.work_offset_mm is None else position_words(status.work_offset_mm)
    yield f"offset:     work zero at machine {offset}"


def spindle_lines(profile: MachineProfile) -> Iterator[str]:
    """Yield lines about what the spindle does while nothing is cut."""
    held, lost = profile.spindle.sentences
    yield f"in a hold:  {held}"
    yield f"link lost:  {lost}"


def program_lines(path: Path, facts: Preflight) -> Iterator[str]:
    """Yield lines about the program and what it needs."""
    yield f"program:    {path.name}: {facts.lines:,} lines, {facts.bytes:,} bytes, about {duration(facts.time_s)}"
    if facts.bounds_mm is not None:
        pairs = zip(_AXES, facts.bounds_mm.least_mm, facts.bounds_mm.most_mm, strict=True)
        spans = (f"{axis} {low:.3f} to {high:.3f}" for axis, low, high in pairs if low is not None and high is not None)
        yield f"extents:    {', '.join(spans)} mm"
    if facts.feeds_mm_per_min is not None:
        low, high = facts.feeds_mm_per_min
        yield f"feed:       {low:g} to {high:g} mm/min, path {facts.path_length_mm / 1000:.2f} m"
    spindle = facts.spindle_rpm
    yield f"spindle:    {f'{spindle[0]:g} to {spindle[1]:g} rpm' if spindle else 'never on in this program'}"
    if facts.assumed:
        yield f"assumed:    {' '.join(facts.assumed)}, which the program does not say itself"
    for warning in facts.warnings:
        yield f"warning:    {warning}"


def stream_command(program: Path, port: str | None, machine: str, how: str) -> str:
    """Return the exact command that continues or repeats a run; it ends with the options in `how`."""
    words = ["causticmill", "stream", str(program)]
    if port is not None:
        words += ["--port", port]
    if machine != DEFAULT_MACHINE:
        words += ["--machine", machine]
    return f"{shlex.join(words)} {how}"


def describe_mill_left(status: MillStatus) -> str:
    """Describe the state in which the mill is left."""
    if status.state is MillState.DISCONNECTED:
        return "the mill cannot be seen: it cuts on what it still holds, and its spindle may turn. Go and look"
    if status.state is MillState.CONNECTING:
        return "the mill has not reported its state since its controller restarted. Go and look"
    spindle = {True: "spindle ON", False: "spindle off", None: "spindle state unknown"}[status.spindle_on]
    where = position_words(status.work_mm)
    return f"the mill is left in state '{status.state.value}' at {where}, {spindle}"


def took_words(run: RunReport | None) -> str:
    """Return how long the run has taken by the clock on the wall, with all its holds."""
    if run is None or run.started_s is None or run.ended_s is None:
        return ""
    return f" in {duration(run.ended_s - run.started_s)}"
