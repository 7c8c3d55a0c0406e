"""What `stream` prints before and after a run: the mill, the program, a fault and the way on."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from machines.driver import DriverFacts, MillState, MillStatus
from machines.preflight.preflight import Preflight
from machines.profile import MachineProfile
from machines.runs import RunReport
from service.errors import printable
from service.milling.terminal.screen import position_words
from service.wording import duration

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
    """Yield how a run without a keyboard is stopped. heard: the signals that stop it, which may be none."""
    commands = [f"`kill -{kind.name.removeprefix('SIG')} {os.getpid()}`" for kind in heard]
    ways = ", ".join(("Ctrl-C", *commands) if signal.SIGINT in heard else commands)
    if ways:
        yield f"to stop:    {ways}: each holds the mill, then aborts from standstill"
    else:
        yield "to stop:    its caller lets no signal through to this command: only at the mill itself"
    yield f"{'':<11} no keys are read here. The mill's own feed hold, reset and emergency stop always work"


def mill_lines(url: str, status: MillStatus, protections: tuple[str, ...], facts: DriverFacts | None) -> Iterator[str]:
    """Yield the machine, where it is, and how the link is guarded."""
    state = f"{status.state.value}{f' ({status.detail})' if status.detail else ''}"
    yield f"mill:       {status.controller or 'unknown controller'} on {url}, {state}"
    yield from place_lines(status)
    if facts is not None:
        yield f"link:       {facts.capacity}; {facts.acknowledgement}"
        yield f"stop:       {facts.stop}"
    for number, words in enumerate(protections or ("none",)):
        yield f"{'protection:' if number == 0 else '           '} {words}"


def place_lines(status: MillStatus) -> Iterator[str]:
    """Yield where the mill is, and how sure that is."""
    sure = "sure" if status.position_trusted else "not sure: not homed, and nobody has said that it is right"
    yield f"position:   work {position_words(status.work_mm)}, machine {position_words(status.machine_mm)}, {sure}"
    offset = "unknown" if status.work_offset_mm is None else position_words(status.work_offset_mm)
    yield f"offset:     work zero at machine {offset}"


def spindle_lines(profile: MachineProfile) -> Iterator[str]:
    """Yield what becomes of the spindle while nobody cuts."""
    held, lost = profile.spindle.sentences
    yield f"in a hold:  {held}"
    yield f"link lost:  {lost}"


def program_lines(path: Path, facts: Preflight) -> Iterator[str]:
    """Yield what the program is and wants."""
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


def recover_command(program: Path, port: str | None, machine: str) -> str:
    """Return the exact command that goes on with a run."""
    words = ["causticmill", "stream", str(program)]
    if port is not None:
        words += ["--port", port]
    if machine != DEFAULT_MACHINE:
        words += ["--machine", machine]
    return shlex.join([*words, "--recover"])


def left_words(status: MillStatus) -> str:
    """Return in which state the mill is left."""
    if status.state is MillState.DISCONNECTED:
        return "the mill cannot be seen: it cuts on what it still holds, and its spindle may turn. Go and look"
    if status.state is MillState.CONNECTING:
        return "the mill has not told its state since its controller restarted. Go and look"
    spindle = {True: "spindle ON", False: "spindle off", None: "spindle state unknown"}[status.spindle_on]
    where = position_words(status.work_mm)
    return f"the mill is left in state '{status.state.value}' at {where}, {spindle}"


def took_words(run: RunReport | None) -> str:
    """Return how long the run has taken by the clock on the wall, with all its holds."""
    if run is None or run.started_s is None or run.ended_s is None:
        return ""
    return f" in {duration(run.ended_s - run.started_s)}"
