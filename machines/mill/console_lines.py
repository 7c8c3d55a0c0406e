"""What a line from the console would change that protects the mill or tells where things are: it is asked for again.

Reading ($$, $#, $G, $I, $N) and plain moves pass. Of what begins with $, only what is known to be harmless passes: a
controller knows more commands than this table. $H, $J, $X, $C and $SLP are refused elsewhere, for commands of their
own. Meanings: GRBL's wiki (v1.1 Commands, v1.1 Configuration), LinuxCNC's G-code reference.
"""

from __future__ import annotations

import re

from machines.gcode.words import strip_block

# The first row that fits counts. A pattern is held against the whole of a $ command, or against one word (G92.1).
EFFECTS: tuple[tuple[str, str], ...] = (
    (r"\$RST=.*", "sets the controller back to factory values: travel, limits, steps per mm and zeros may be gone"),
    (r"\$N\d*=.*", "stores a line that the controller runs by itself each time it is reset or switched on"),
    (r"\$[01]=.*", "changes how the motors are driven and held: steps may be lost"),
    (r"\$[2-6]=.*", "changes what the signals mean: axes may run the wrong way, limits or probe may go unseen"),
    (r"\$10=.*", "changes what the controller reports: positions may be missing or mean something else"),
    (r"\$13=.*", "changes the unit of the reports, mm or inches: positions may be read 25.4 times wrong"),
    (r"\$20=0", "switches the soft limits off: nothing stops the mill before the end of its travel"),
    (r"\$21=0", "switches the limit switches off: nothing stops the mill at the end of its travel"),
    (r"\$22=0", "switches homing off: the mill does not know where its travel ends"),
    (r"\$2[3-7]=.*", "changes how the mill homes: where its travel begins may be wrong"),
    (r"\$3[01]=.*", "changes which spindle speed an S word means"),
    (r"\$32=1", "switches laser mode on: the spindle stops in every rapid and turns slower in slow moves"),
    (r"\$10[0-9]=.*", "changes the steps per mm: every length is wrong until it has been measured again"),
    (r"\$1[12][0-9]=.*", "changes how fast an axis may move or speed up: steps may be lost"),
    (r"\$13[0-9]=.*", "changes the travel that the soft limits guard"),
    (r"\$(F|SD/RUN|LOCALFS/RUN)=.*", "runs a file of the controller's own, which nobody has checked"),
    (r"\$[^=]*=.*", "changes a setting of the controller, for good"),
    (r"\$(\$|#|G|I|N|\d+|[HJXC].*|SLP)?", ""),
    (r"\$.*", "is a command that is not known here: it may move the mill or change what protects it"),
    (r"\[.*", "is a command to the controller's files and network: it may run a file or change a setting"),
    (r"#.*", "writes a parameter of the controller, which may be a zero or the length of a tool"),
    (r"G10", "sets a work zero or a tool's length: what is cut afterwards lies elsewhere"),
    (r"G92(\.[123])?|G52", "shifts the work zero: what is cut afterwards lies elsewhere"),
    (r"G5[5-9]|G59\.[123]", "selects another work coordinate system, whose zero may lie anywhere"),
    (r"G43(\.[12])?|G49", "changes the length of the tool in use: Z lies elsewhere"),
    (r"G5[01]|G6[89]", "scales, mirrors or turns what is cut afterwards"),
    (r"G28\.1|G30\.1", "stores this place as the one to which G28 or G30 drives"),
    (r"G20", "reads all numbers from now on as inches"),
)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
_WORD, _SETTING = re.compile(f"([A-Z])({_NUMBER})"), re.compile(rf"\$({_NUMBER})=(.*)")


def describe_effect(text: str) -> str:
    """What the line would change, as the end of a sentence that begins with it; "" where it need not be asked for."""
    line = strip_block(text.encode("ascii", "replace")).decode()
    parts = (
        [_normalize_setting(line)] if line[:1] in ("$", "[", "#") else [_word(*found) for found in _WORD.findall(line)]
    )
    for part in parts:
        if words := next((words for pattern, words in EFFECTS if re.fullmatch(pattern, part)), ""):
            return words
    return ""


def _normalize_setting(line: str) -> str:
    """$020=0.0 is $20=0 to a controller."""
    if found := _SETTING.fullmatch(line):
        number, value = found.groups()
        return f"${_plain(number)}={_plain(value) if re.fullmatch(_NUMBER, value) else value}"
    return line


def _word(letter: str, number: str) -> str:
    """G092.10 is G92.1 to a controller."""
    return f"{letter}{_plain(number)}"


def _plain(number: str) -> str:
    return f"{float(number):g}"
