"""The numbers of `error:n` and `ALARM:n` in words, each with what to do (GRBL 1.1 wiki; grblHAL and FluidNC extend)."""

from __future__ import annotations

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

# After these the controller listens to nothing but a reset, not even to '?'.
CRITICAL_ALARMS = frozenset({1, 2, 10})
# After these machine coordinates mean nothing any more (reference/machines.md, 7.2).
POSITION_LOST_ALARMS = frozenset({1, 3, 6, 7, 8, 9, 10, 15, 16, 17})
# These leave the spindle as it was; with every other the firmware has stopped it.
SPINDLE_ON_ALARMS = frozenset({4, 5, 11, 12, 13})


def error_words(number: int) -> Phrase:
    """Return `error:20 (G or M code not supported: ...)`."""
    return Phrase("error:{number} ({meaning})", number=number, meaning=ERRORS.get(number, _UNLISTED))


def alarm_words(number: int) -> Phrase:
    """Return `ALARM:2 (move would leave the travel ...)`."""
    return Phrase("ALARM:{number} ({meaning})", number=number, meaning=ALARMS.get(number, _UNLISTED))
