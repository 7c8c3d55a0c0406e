"""A complete grammar of the replies of GRBL 1.1, grblHAL and FluidNC: every line is one of these replies, or Garbled.

It is strict on purpose: a line that is almost right was damaged on the way, and a damaged line is a fault of the link.
Padding around a line is ignored: blanks, a second CR, NULs. `OK` counts as a spelling of `ok`, because it would take
two damaged bytes to turn one into the other. Messages for the operator may contain anything. The module also has words
for the numbers of `error:n` and `ALARM:n`, each with a remedy (GRBL 1.1 wiki; grblHAL and FluidNC extend).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from phrases.phrase import Phrase

ERRORS: dict[int, Phrase] = {
    1: Phrase("a word does not begin with a letter: correct the block"),
    2: Phrase("a number is missing or badly written: correct the block"),
    3: Phrase("this '$' command is not known: check its spelling"),
    4: Phrase("the value must not be negative: correct it"),
    5: Phrase("homing is switched off: set $22=1, or set the zero by hand"),
    6: Phrase("step pulse under 3 us: set $0 to 3 or more"),
    7: Phrase("settings memory could not be read and was set to defaults: check $$ before any motion"),
    8: Phrase("this '$' command needs an idle mill: wait until it stands still"),
    9: Phrase("locked by an alarm or a jog: home ($H) or unlock ($X) first"),
    10: Phrase("soft limits need homing: set $22=1 first"),
    11: Phrase("line longer than the controller takes: split the block"),
    12: Phrase("step rate over 30 kHz: lower $110-$112 or the steps per mm"),
    13: Phrase("safety door open: close it and resume"),
    14: Phrase("startup line too long: shorten $N"),
    15: Phrase("jog would leave the travel: jog less far"),
    16: Phrase("jog without axis or with a forbidden word: correct it"),
    17: Phrase("laser mode needs a PWM spindle: set $32=0"),
    18: Phrase("reset asserted: release it and reset again"),
    19: Phrase("value not positive: correct it"),
    20: Phrase("G or M code not supported: remove or translate it"),
    21: Phrase("two codes of one modal group: keep one"),
    22: Phrase("feed not set: give F before the first G1"),
    23: Phrase("code needs a whole number: correct it"),
    24: Phrase("two codes that both use axis words: split the block"),
    25: Phrase("a word is repeated in the block: keep one"),
    26: Phrase("axis words are missing: correct the block"),
    27: Phrase("line number out of range: remove N words"),
    28: Phrase("a value word (P, L, ...) is missing: correct the block"),
    29: Phrase("work offset not supported: use G54 to G59"),
    30: Phrase("G53 needs G0 or G1: correct the block"),
    31: Phrase("axis words without a motion that uses them: correct the block"),
    32: Phrase("arc without axis words in its plane: correct the block"),
    33: Phrase("arc end does not lie on its circle: correct I J K"),
    34: Phrase("arc radius impossible: correct R"),
    35: Phrase("arc without I J K or R: correct the block"),
    36: Phrase("words that no code uses: remove them"),
    37: Phrase("G43.1 needs the tool-length axis: correct the block"),
    38: Phrase("tool number too large: use a smaller T"),
    39: Phrase("P value too large: correct it"),
    40: Phrase("(grblHAL) tool change still pending: finish it first"),
    45: Phrase("(grblHAL) the mill must be homed first: run $H"),
    46: Phrase("(grblHAL) the mill must be homed first: run $H"),
    79: Phrase("(grblHAL) not allowed while the controller is in alarm: clear the alarm and reset"),
}

ALARMS: dict[int, Phrase] = {
    1: Phrase("hard limit hit, position lost: free the axis, home again"),
    2: Phrase("move would leave the travel (soft limit), position kept: unlock, check zero and program"),
    3: Phrase("reset while moving, position lost: home or set the zero again"),
    4: Phrase("probe was already touching, or not connected: check the probe"),
    5: Phrase("probe did not touch within its travel: move closer and repeat"),
    6: Phrase("homing stopped by a reset: home again"),
    7: Phrase("homing stopped by the safety door: close it, home again"),
    8: Phrase("homing could not leave the switch: check switch, wiring and $27"),
    9: Phrase("homing did not find the switch: check switch, wiring and travel"),
    10: Phrase("homing of a second motor failed, or emergency stop (grblHAL): release it, reset, home again"),
    11: Phrase("(grblHAL) homing required: run $H"),
    12: Phrase("(grblHAL) a limit switch is touching: move off it"),
    13: Phrase("(grblHAL) probe protection tripped: check the probe"),
    14: Phrase("(grblHAL) spindle did not reach its speed: check the spindle"),
    15: Phrase("(grblHAL) homing of the second motor failed: check both switches"),
    16: Phrase("(grblHAL) power-on self test failed: check the controller"),
    17: Phrase("(grblHAL) motor fault: check drives and power"),
}

_UNLISTED = Phrase("not in the list of GRBL 1.1: see the manual of this controller")

# After these the controller only accepts a reset, not even '?'.
CRITICAL_ALARMS = frozenset({1, 2, 10})
# After these, machine coordinates are no longer valid (reference/machines.md, 7.2).
POSITION_LOST_ALARMS = frozenset({1, 3, 6, 7, 8, 9, 10, 15, 16, 17})
# These leave the spindle as it was; with every other alarm the firmware has stopped it.
SPINDLE_ON_ALARMS = frozenset({4, 5, 11, 12, 13})


def error_words(number: int) -> Phrase:
    """Return `error:20 (G or M code not supported: ...)`."""
    return Phrase("error:{number} ({meaning})", number=number, meaning=ERRORS.get(number, _UNLISTED))


def alarm_words(number: int) -> Phrase:
    """Return `ALARM:2 (move would leave the travel ...)`."""
    return Phrase("ALARM:{number} ({meaning})", number=number, meaning=ALARMS.get(number, _UNLISTED))


# Longest line a controller sends ($-help and board descriptions of grblHAL stay under 300 bytes).
LONGEST_LINE = 1024
_PADDING = b"\r\0 \t"


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was taken."""


@dataclass(frozen=True, slots=True)
class ErrorReply:
    """A line was refused."""

    number: int


@dataclass(frozen=True, slots=True)
class AlarmReply:
    """The controller stopped and locked itself."""

    number: int


@dataclass(frozen=True, slots=True)
class Status:
    """One report `<...>`. Positions in report units (mm, or inch with $13=1); None if the report has no such field.

    accessories : letters of A:, "" when overrides were reported without it (nothing is on), None when not reported
    """

    state: str
    sub: int | None = None
    machine: tuple[float, ...] | None = None
    work: tuple[float, ...] | None = None
    work_offset: tuple[float, ...] | None = None
    feed: float | None = None
    spindle: float | None = None
    buffer: tuple[int, int] | None = None
    overrides: tuple[int, int, int] | None = None
    pins: str = ""
    line: int | None = None
    accessories: str | None = None


@dataclass(frozen=True, slots=True)
class Message:
    """[MSG:...]: words for the operator."""

    text: str


@dataclass(frozen=True, slots=True)
class Echo:
    """[echo: ...]: the line as the controller has read it."""

    text: bytes


@dataclass(frozen=True, slots=True)
class Push:
    """[TAG:body], e.g. GC, G54, PRB, TLO, VER, OPT."""

    tag: str
    body: str


@dataclass(frozen=True, slots=True)
class Setting:
    """$n=value."""

    number: int
    value: str

    @property
    def has_comma(self) -> bool:
        """Return whether the value is a number with a decimal comma."""
        return _COMMA.match(self.value) is not None


@dataclass(frozen=True, slots=True)
class Startup:
    """>block:ok, a startup line was run."""

    text: str


@dataclass(frozen=True, slots=True)
class Banner:
    """The controller has started."""

    text: str


@dataclass(frozen=True, slots=True)
class Empty:
    """A line without content (before the banner)."""


@dataclass(frozen=True, slots=True)
class Garbled:
    """A line that no controller sends."""

    raw: bytes


Reply = Ok | ErrorReply | AlarmReply | Status | Message | Echo | Push | Setting | Startup | Banner | Empty | Garbled

OK, EMPTY = Ok(), Empty()
STATES = frozenset({"Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep", "Tool"})
_CODE = re.compile(rb"(error|ALARM):(\d{1,3})$")
_SETTING = re.compile(rb"\$(\d{1,4})=([ -~]*)$")
_PUSH = re.compile(rb"\[([A-Z][A-Z0-9 .]*):([ -~]*)\]$")
_MESSAGE = re.compile(rb"\[MSG(?::([^\x00-\x1f\x7f]*))?\]$", re.IGNORECASE)
_BANNER = re.compile(rb"(?:Grbl|GrblHAL|grblHAL|FluidNC) [ -~]*\[[ -~]*'\$'[ -~]*\]$")
_STARTUP = re.compile(rb">[ -~]*:(?:ok|error:\d{1,3})$")
_COMMA = re.compile(r"-?\d+,\d{3}$")
_NUMBERS = re.compile(r"-?\d+(?:\.\d*)?(?:,-?\d+(?:\.\d*)?)*$")
_FIELD = re.compile(r"[A-Za-z]+\d*$")


def parse(line: bytes) -> Reply:
    """Return the reply in one line (without its line end). Never raises."""
    if line in (b"ok", b"OK"):
        return OK
    if not line:
        return EMPTY
    first = line[0]
    if first == 0x3C:  # <
        return _status(line)
    if first == 0x5B:  # [
        return _bracket(line)
    if found := _CODE.match(line):
        number = int(found[2])
        return ErrorReply(number) if found[1] == b"error" else AlarmReply(number)
    if found := _SETTING.match(line):
        return Setting(int(found[1]), found[2].decode("ascii"))
    if _BANNER.match(line):
        return Banner(line.decode("ascii"))
    if _STARTUP.match(line):
        return Startup(line.decode("ascii"))
    return Garbled(line)


# Lines of other firmware, and of firmware like GRBL 1.1 that is not supported; each is refused by name.
_FOREIGN: tuple[tuple[re.Pattern[bytes], str], ...] = (
    (re.compile(rb"Grbl 0\.|<[A-Z]\w+,[MW]Pos:"), Phrase("GRBL 0.9 or older")),
    (re.compile(rb"Smoothie|Build version: |<[A-Z]\w+\|MPos:[-\d.,]+\|WPos:"), "Smoothieware"),
    (re.compile(rb"(echo: ?)?Marlin |echo:Unknown command|//action:|FIRMWARE_NAME:Marlin"), "Marlin"),
    (re.compile(rb"RepRapFirmware|FIRMWARE_NAME: ?RepRap"), "RepRapFirmware"),
    (re.compile(rb"// Klipper|Klipper state"), "Klipper"),
    (re.compile(rb'\{"(r|sr|er|f)":'), Phrase("TinyG or g2core")),
    (re.compile(rb"<[A-Z]\w+(:\d+)?\|[MW]Pos:-?\d+,\d{3},-?\d+,\d{3},"), Phrase("firmware that writes decimal commas")),
)
_BOOT = re.compile(rb"ets [A-Z][a-z]{2} +\d|rst:0x|ESP-ROM:")


def name_foreign(line: bytes) -> str | None:
    """Return the name of the firmware that sends this line; None if it is not known, or if we support it."""
    return next((name for pattern, name in _FOREIGN if pattern.match(line)), None)


def is_boot_text(line: bytes) -> bool:
    """Return whether an ESP32 sends this line when it starts."""
    return _BOOT.match(line) is not None


def _bracket(line: bytes) -> Reply:
    if line.startswith(b"[echo:") and line.endswith(b"]"):
        return Echo(line[6:-1].strip())
    if found := _MESSAGE.match(line):
        return Message((found[1] or b"").decode("utf-8", "backslashreplace"))
    found = _PUSH.match(line)
    return Push(found[1].decode("ascii"), found[2].decode("ascii")) if found else Garbled(line)


def _status(line: bytes) -> Reply:
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return Garbled(line)
    if not text.endswith(">") or not text.isprintable():
        return Garbled(line)
    head, *parts = text[1:-1].split("|")
    state, colon, sub = head.partition(":")
    if state not in STATES or (colon and not (sub.isdecimal() and len(sub) < 4)) or not parts:
        return Garbled(line)
    values: dict[str, str] = {}
    for part in parts:
        key, colon, value = part.partition(":")
        if not _FIELD.match(key) or key in values:
            return Garbled(line)
        values[key] = value
    return _fields(line, state, int(sub) if sub else None, values)


def _fields(line: bytes, state: str, sub: int | None, values: dict[str, str]) -> Reply:
    try:
        machine, work = _axes(values, "MPos"), _axes(values, "WPos")
        offset = _axes(values, "WCO")
        feed, spindle = None, None
        if "FS" in values:
            feed, spindle = _numbers(values, "FS", 2)[:2]
        elif "F" in values:
            feed = _numbers(values, "F", 1)[0]
        buffer = _numbers(values, "Bf", 2) if "Bf" in values else None
        overrides = _numbers(values, "Ov", 3) if "Ov" in values else None
        line_number = int(_numbers(values, "Ln", 1)[0]) if "Ln" in values else None
    except ValueError:
        return Garbled(line)
    if (machine is None) == (work is None):
        return Garbled(line)  # exactly one of the two is always there
    return Status(
        state=state,
        sub=sub,
        machine=machine,
        work=work,
        work_offset=offset,
        feed=feed,
        spindle=spindle,
        buffer=(int(buffer[0]), int(buffer[1])) if buffer else None,
        overrides=(int(overrides[0]), int(overrides[1]), int(overrides[2])) if overrides else None,
        pins=values.get("Pn", ""),
        line=line_number,
        accessories=values.get("A", "" if overrides else None),
    )


def _axes(values: dict[str, str], key: str) -> tuple[float, ...] | None:
    return _numbers(values, key, 3) if key in values else None


def _numbers(values: dict[str, str], key: str, at_least: int) -> tuple[float, ...]:
    text = values[key]
    if len(text) > 200 or not _NUMBERS.match(text):
        raise ValueError(key)
    numbers = tuple(map(float, text.split(",")))
    if len(numbers) < at_least or (len(numbers) > 4 and "." not in text):  # decimal commas: 30,000 is not 30 and 0
        raise ValueError(key)
    return numbers


def show(text: bytes) -> str:
    """Return a line in readable form."""
    words = text.decode("ascii", "backslashreplace")
    return words if len(words) <= 80 else words[:77] + "..."


class LineSplitter:
    """Splits received bytes into lines without padding. A line that never ends is cut off and becomes Garbled."""

    def __init__(self) -> None:
        self._rest = b""

    def take(self, data: bytes) -> list[bytes]:
        lines = (self._rest + data).split(b"\n")
        rest = lines.pop()
        if len(rest) > LONGEST_LINE:
            lines.append(rest)
            rest = b""
        self._rest = rest
        return [line.strip(_PADDING) for line in lines]

    def clear(self) -> None:
        self._rest = b""

    @property
    def rest(self) -> bytes:
        """The bytes of an unfinished line."""
        return self._rest
