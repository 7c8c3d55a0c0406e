"""Orders beside a run in words, for whoever watches: what was asked for, and what came of it."""

from __future__ import annotations

from machines.driver import (
    CheckMode,
    Command,
    CommandDone,
    Home,
    Jog,
    JogCancel,
    Override,
    ProbeZ,
    ReadSettings,
    Reset,
    SendBlock,
    SetZero,
    Triple,
    TrustPosition,
    Unlock,
)

_AXES = "XYZ"
_STEP_MM = 0.02  # of a coarse mill: its jogs end that much beside what they were asked for
_NAMES: dict[type[Command], str] = {
    Home: "Home",
    Unlock: "Unlock",
    Reset: "Reset",
    JogCancel: "End jog",
    TrustPosition: "Position taken as right",
    ReadSettings: "Read settings",
}


def command_words(done: CommandDone, *, from_mm: Triple | None, at_mm: Triple | None) -> str:
    """A line of the log. from_mm, at_mm: machine coordinates before a jog, and now."""
    return f"{_word_question(done.command)}: {done.failure or _came_of_it(done, from_mm, at_mm)}"


def _word_question(command: Command) -> str:
    match command:
        case Jog():
            return f"Jog {_way(command.by_mm)}"
        case ProbeZ():
            return f"Probe Z down by at most {command.depth_mm:g} mm, plate {command.plate_mm:g} mm"
        case SetZero():
            return f"{_together(command.axes)} = 0 here"
        case Override():
            return f"{'rapids' if command.what == 'rapid' else command.what} at {command.percent} %".capitalize()
        case CheckMode():
            return f"Check mode {'on' if command.on else 'off'}"
        case SendBlock():
            return f"Line {command.text}"
        case _:
            return _NAMES[type(command)]


def _came_of_it(done: CommandDone, from_mm: Triple | None, at_mm: Triple | None) -> str:
    match done.command:
        case Jog(by_mm=by_mm) if from_mm is not None and at_mm is not None:
            gone_mm = (at_mm[0] - from_mm[0], at_mm[1] - from_mm[1], at_mm[2] - from_mm[2])
            if all(abs(gone - by) <= _STEP_MM for gone, by in zip(gone_mm, by_mm, strict=True)):
                return "done"
            return f"ended after {_way(gone_mm)}"
        case SetZero(axes=axes) if at_mm is not None:
            places = (f"{axis} {at_mm[_AXES.index(axis)]:.3f}" for axis in axes)
            return f"done, at machine {', '.join(places)} mm"
        case ProbeZ() if isinstance(contact := done.answer.get("contact_machine_mm"), list):
            return f"touched at machine Z {contact[2]:.3f} mm"
        case _:
            return "done"


def _way(by_mm: Triple) -> str:
    """As in "X +10 mm, Z -0.5 mm"."""
    moved = ((axis, round(by, 3)) for axis, by in zip(_AXES, by_mm, strict=True))
    return ", ".join(f"{axis} {by:+g} mm" for axis, by in moved if by) or "by nothing"


def _together(axes: str) -> str:
    """As in "X, Y and Z"."""
    return " and ".join((", ".join(axes[:-1]), axes[-1])) if len(axes) > 1 else axes
