"""Commands outside a run: sends them, describes how they ended, and judges what a console line would change.

A console line that changes a protection of the mill, or the coordinates, needs a second confirmation. Reading ($$, $#,
$G, $I, $N) and plain moves pass. Of the lines that begin with $, only those known to be harmless pass: a controller
knows more commands than this table. $H, $J, $X, $C and $SLP are refused elsewhere, for commands of their own. Meanings:
GRBL's wiki (v1.1 Commands, v1.1 Configuration), LinuxCNC's G-code reference.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from machines.driver import (
    CheckMode,
    Command,
    CommandDone,
    Home,
    Jog,
    JogCancel,
    Override,
    ProbeCorner,
    ProbeZ,
    ReadSettings,
    Reset,
    SendBlock,
    SetZero,
    Spindle,
    Travel,
    Triple,
    TrustPosition,
    Unlock,
)
from machines.errors import JournalError, MillCode, NotAllowedError, WrongStateError
from machines.gcode.text import strip_block
from machines.mill.link import get_settings
from machines.mill.orders import NOBODY, Caller, Order
from machines.mill.run_control import UnattendedRuns
from machines.mill.view import MillContext
from phrases.phrase import Phrase

_MOVES_NOTHING = (ReadSettings, Override, JogCancel)
_ASK_FIRST = (ProbeZ, ProbeCorner, Override)  # from the controller, for its modes or the present override
_AXES = "XYZ"
_STEP_MM = 0.02  # step of a coarse mill: its jogs may end that far from the requested position
_NAMES: dict[type[Command], Phrase] = {
    Home: Phrase("Home"),
    Unlock: Phrase("Unlock"),
    Reset: Phrase("Reset"),
    JogCancel: Phrase("End jog"),
    TrustPosition: Phrase("Position trusted"),
    ReadSettings: Phrase("Read settings"),
}

# The first row that matches counts. A pattern must match the whole of a $ command, or one word (G92.1).
EFFECTS: tuple[tuple[str, Phrase], ...] = (
    (
        r"\$RST=.*",
        Phrase("sets the controller back to factory values: travel, limits, steps per mm and zeros may be gone"),
    ),
    (r"\$N\d*=.*", Phrase("stores a line that the controller runs by itself each time it is reset or switched on")),
    (r"\$[01]=.*", Phrase("changes how the motors are driven and held: steps may be lost")),
    (r"\$[2-6]=.*", Phrase("changes what the signals mean: axes may run the wrong way, limits or probe may go unseen")),
    (r"\$10=.*", Phrase("changes what the controller reports: positions may be missing or mean something else")),
    (r"\$13=.*", Phrase("changes the unit of the reports, mm or inches: positions may be read 25.4 times wrong")),
    (r"\$20=0", Phrase("switches the soft limits off: nothing stops the mill before the end of its travel")),
    (r"\$21=0", Phrase("switches the limit switches off: nothing stops the mill at the end of its travel")),
    (r"\$22=0", Phrase("switches homing off: the mill does not know where its travel ends")),
    (r"\$2[3-7]=.*", Phrase("changes how the mill homes: where its travel begins may be wrong")),
    (r"\$3[01]=.*", Phrase("changes which spindle speed an S word means")),
    (r"\$32=1", Phrase("switches laser mode on: the spindle stops in every rapid and turns slower in slow moves")),
    (r"\$10[0-9]=.*", Phrase("changes the steps per mm: every length is wrong until it has been measured again")),
    (r"\$1[12][0-9]=.*", Phrase("changes how fast an axis may move or speed up: steps may be lost")),
    (r"\$13[0-9]=.*", Phrase("changes the travel that the soft limits guard")),
    (r"\$(F|SD/RUN|LOCALFS/RUN)=.*", Phrase("runs a file of the controller's own, which nobody has checked")),
    (r"\$[^=]*=.*", Phrase("changes a setting of the controller, for good")),
    (r"\$(\$|#|G|I|N|\d+|[HJXC].*|SLP)?", Phrase("")),
    (r"\$.*", Phrase("is an unknown command: it may move the mill or change what protects it")),
    (r"\[.*", Phrase("is a command to the controller's files and network: it may run a file or change a setting")),
    (r"#.*", Phrase("writes a parameter of the controller, which may be a zero or the length of a tool")),
    (r"G10", Phrase("sets a work zero or a tool's length: what is cut afterwards lies elsewhere")),
    (r"G92(\.[123])?|G52", Phrase("shifts the work zero: what is cut afterwards lies elsewhere")),
    (r"G5[5-9]|G59\.[123]", Phrase("selects another work coordinate system, whose zero may lie anywhere")),
    (r"G43(\.[12])?|G49", Phrase("changes the length of the tool in use: Z lies elsewhere")),
    (r"G5[01]|G6[89]", Phrase("scales, mirrors or turns what is cut afterwards")),
    (r"G28\.1|G30\.1", Phrase("stores this place as the target of G28 or G30")),
    (r"G20", Phrase("reads all numbers from now on as inches")),
)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
_WORD, _SETTING = re.compile(f"([A-Z])({_NUMBER})"), re.compile(rf"\$({_NUMBER})=(.*)")


@dataclass(eq=False)
class Commands:
    """Sends a person's commands outside a run, and records what they have changed."""

    context: MillContext
    unattended: UnattendedRuns
    _last: tuple[Command, Caller] | None = None  # the last command and its caller
    _jog_from_mm: Triple | None = None  # machine coordinates

    def send(self, command: Command, order: Order) -> None:
        driver = self.context.link.driver
        if driver is None:
            words = f"{type(command).__name__}: the mill is disconnected ({self.context.link.problem})"
            raise WrongStateError(words, MillCode.MILL_STATE, self.context.link.status.state)
        if not isinstance(command, _MOVES_NOTHING) and self.context.runs.live is None:
            self.unattended.watch()
            try:
                self.unattended.note_touch()
            except JournalError as error:
                raise NotAllowedError(
                    Phrase(
                        "{command}: {error}; an interrupted run depends on it",
                        command=type(command).__name__,
                        error=error.words,
                    )
                ) from None
        stood_mm = driver.status.machine_mm
        if isinstance(command, _ASK_FIRST):
            order.require()
            order.extend()
        driver.command(command, order.require)
        if isinstance(command, Travel):
            order.note_begun()
        self._last = (command, order.caller)
        if isinstance(command, Jog):
            self._jog_from_mm = stood_mm

    def note_end(self, event: CommandDone) -> None:
        command, setup = event.command, self.context.link.setup
        words = command_words(event, from_mm=self._jog_from_mm, at_mm=self.context.link.status.machine_mm)
        caller = self._last[1] if self._last is not None and self._last[0] is command else NOBODY
        read = isinstance(command, ReadSettings) and not event.failure
        answer = {**event.answer, **self._measure_jog(event)}
        self.context.log.say("command", words, answer, caller, code=MillCode.SETTINGS_READ if read else "")
        if event.failure:
            return
        if isinstance(command, ReadSettings):
            setup.parser_state = str(event.answer.get("parser_state", "")) or None
        axes = _find_axes_zeroed(command)
        if isinstance(command, Home):
            setup.homed = True
        if isinstance(command, TrustPosition) and self._last is not None and self._last[0] is command:
            self.context.runs.note_trust(get_settings(self.context.link.driver))
        if "Z" in axes:
            self.context.runs.note_touch_off()
        if axes:
            setup.zeroed = "".join(sorted({*setup.zeroed, *axes}))
            setup.zeroed_anew = "".join(sorted({*setup.zeroed_anew, *axes}))
            self.context.runs.note_zero(axes)

    def _measure_jog(self, event: CommandDone) -> dict[str, object]:
        """Return how far a jog has gone, and where the tool is now (machine coordinates), if the link reports it."""
        at_mm, from_mm = self.context.link.status.machine_mm, self._jog_from_mm
        if not isinstance(event.command, Jog) or at_mm is None or from_mm is None:
            return {}
        moved_mm = [round(at - begun, 4) for at, begun in zip(at_mm, from_mm, strict=True)]
        return {"moved_mm": moved_mm, "at_machine_mm": list(at_mm)}


def _find_axes_zeroed(command: Command) -> str:
    match command:
        case SetZero(axes=axes):
            return axes
        case ProbeZ():
            return "Z"
        case ProbeCorner():
            return "XYZ"
        case _:
            return ""


def command_words(done: CommandDone, *, from_mm: Triple | None, at_mm: Triple | None) -> Phrase:
    """Return a line of the log. from_mm, at_mm: machine coordinates before a jog, and now."""
    outcome = done.failure or _came_of_it(done, from_mm, at_mm)
    return Phrase("{command}: {outcome}", command=_describe_question(done.command), outcome=outcome)


def _describe_question(command: Command) -> Phrase:
    match command:
        case Jog():
            return Phrase("Jog {way}", way=_way(command.by_mm))
        case Travel():
            return command.name
        case ProbeZ():
            return Phrase(
                "Probe Z down by at most {depth_mm:g} mm, plate {plate_mm:g} mm",
                depth_mm=command.depth_mm,
                plate_mm=command.plate_mm,
            )
        case ProbeCorner():
            return Phrase(
                "Probe the corner, cutter of radius {radius_mm:g} mm, plate {plate_mm:g} mm",
                radius_mm=command.cutter_radius_mm,
                plate_mm=command.plate_mm,
            )
        case SetZero():
            return Phrase("{axes} = 0 here", axes=_together(command.axes))
        case Override(what="rapid"):
            return Phrase("Rapids at {percent} %", percent=command.percent)
        case Override(what="spindle"):
            return Phrase("Spindle at {percent} %", percent=command.percent)
        case Override():
            return Phrase("Feed at {percent} %", percent=command.percent)
        case CheckMode():
            return Phrase("Check mode on") if command.on else Phrase("Check mode off")
        case Spindle(rpm=None):
            return Phrase("Spindle off")
        case Spindle(rpm=rpm):
            return Phrase("Spindle on at {rpm:g} rpm", rpm=rpm)
        case SendBlock():
            return Phrase("Line {text}", text=command.text)
        case _:
            return _NAMES[type(command)]


def _came_of_it(done: CommandDone, from_mm: Triple | None, at_mm: Triple | None) -> Phrase:
    match done.command:
        case Jog(by_mm=by_mm) if from_mm is not None and at_mm is not None:
            gone_mm = (at_mm[0] - from_mm[0], at_mm[1] - from_mm[1], at_mm[2] - from_mm[2])
            if all(abs(gone - by) <= _STEP_MM for gone, by in zip(gone_mm, by_mm, strict=True)):
                return Phrase("done")
            return Phrase("ended after {way}", way=_way(gone_mm))
        case SetZero(axes=axes) if at_mm is not None:
            places = (f"{axis} {at_mm[_AXES.index(axis)]:.3f}" for axis in axes)
            return Phrase("done, at machine {place_mm} mm", place_mm=", ".join(places))
        case ProbeZ() if isinstance(contact := done.answer.get("contact_machine_mm"), list):
            return Phrase("touched at machine Z {contact_mm:.3f} mm", contact_mm=contact[2])
        case ProbeCorner() if isinstance(contact := done.answer.get("contact_machine_mm"), list):
            places = (f"{axis} {mm:.3f}" for axis, mm in zip(_AXES, contact, strict=True))
            return Phrase("touched at machine {place_mm} mm", place_mm=", ".join(places))
        case _:
            return Phrase("done")


def _way(by_mm: Triple) -> str:
    """Describe a jog, as in "X +10 mm, Z -0.5 mm"."""
    moved = ((axis, round(by, 3)) for axis, by in zip(_AXES, by_mm, strict=True))
    return ", ".join(f"{axis} {by:+g} mm" for axis, by in moved if by) or Phrase("by nothing")


def _together(axes: str) -> str:
    """Join words, as in "X, Y and Z"."""
    return Phrase("{first} and {last}", first=", ".join(axes[:-1]), last=axes[-1]) if len(axes) > 1 else axes


def describe_effect(text: str) -> Phrase:
    """Return the effect of the line, as the end of a sentence that begins with the line; "" if it needs no
    confirmation.
    """
    line = strip_block(text.encode("ascii", "replace")).decode()
    parts = (
        [_normalize_setting(line)] if line[:1] in ("$", "[", "#") else [_word(*found) for found in _WORD.findall(line)]
    )
    for part in parts:
        if words := next((words for pattern, words in EFFECTS if re.fullmatch(pattern, part)), Phrase("")):
            return words
    return Phrase("")


def _normalize_setting(line: str) -> str:
    """Normalise a setting: to a controller, $020=0.0 is $20=0."""
    if found := _SETTING.fullmatch(line):
        number, value = found.groups()
        return f"${_plain(number)}={_plain(value) if re.fullmatch(_NUMBER, value) else value}"
    return line


def _word(letter: str, number: str) -> str:
    """Normalise a word: to a controller, G092.10 is G92.1."""
    return f"{letter}{_plain(number)}"


def _plain(number: str) -> str:
    return f"{float(number):g}"
