"""The numbers of `error:n` and `ALARM:n` in words, each with what to do (GRBL 1.1 wiki; grblHAL and FluidNC extend)."""

from __future__ import annotations

ERRORS: dict[int, str] = {
    1: "a word does not begin with a letter: correct the block",
    2: "a number is missing or badly written: correct the block",
    3: "this '$' command is not known: check its spelling",
    4: "the value must not be negative: correct it",
    5: "homing is switched off: set $22=1, or set the zero by hand",
    6: "step pulse under 3 us: set $0 to 3 or more",
    7: "settings memory could not be read and was set to defaults: check $$ before any motion",
    8: "this '$' command needs an idle mill: wait until it stands still",
    9: "locked by an alarm or a jog: home ($H) or unlock ($X) first",
    10: "soft limits need homing: set $22=1 first",
    11: "line longer than the controller takes: split the block",
    12: "step rate over 30 kHz: lower $110-$112 or the steps per mm",
    13: "safety door open: close it and resume",
    14: "startup line too long: shorten $N",
    15: "jog would leave the travel: jog less far",
    16: "jog without axis or with a forbidden word: correct it",
    17: "laser mode needs a PWM spindle: set $32=0",
    18: "reset asserted: release it and reset again",
    19: "value not positive: correct it",
    20: "G or M code not supported: remove or translate it",
    21: "two codes of one modal group: keep one",
    22: "feed not set: give F before the first G1",
    23: "code needs a whole number: correct it",
    24: "two codes that both use axis words: split the block",
    25: "a word is repeated in the block: keep one",
    26: "axis words are missing: correct the block",
    27: "line number out of range: remove N words",
    28: "a value word (P, L, ...) is missing: correct the block",
    29: "work offset not supported: use G54 to G59",
    30: "G53 needs G0 or G1: correct the block",
    31: "axis words without a motion that uses them: correct the block",
    32: "arc without axis words in its plane: correct the block",
    33: "arc end does not lie on its circle: correct I J K",
    34: "arc radius impossible: correct R",
    35: "arc without I J K or R: correct the block",
    36: "words that no code uses: remove them",
    37: "G43.1 needs the tool-length axis: correct the block",
    38: "tool number too large: use a smaller T",
    39: "P value too large: correct it",
    40: "(grblHAL) tool change still pending: finish it first",
    45: "(grblHAL) the mill must be homed first: run $H",
    46: "(grblHAL) the mill must be homed first: run $H",
    79: "(grblHAL) not allowed while an alarm of the controller stands: clear it and reset",
}

ALARMS: dict[int, str] = {
    1: "hard limit hit, position lost: free the axis, home again",
    2: "move would leave the travel (soft limit), position kept: unlock, check zero and program",
    3: "reset while moving, position lost: home or set the zero again",
    4: "probe was already touching, or not connected: check the probe",
    5: "probe did not touch within its travel: move closer and repeat",
    6: "homing stopped by a reset: home again",
    7: "homing stopped by the safety door: close it, home again",
    8: "homing could not leave the switch: check switch, wiring and $27",
    9: "homing did not find the switch: check switch, wiring and travel",
    10: "homing of a second motor failed, or emergency stop (grblHAL): release it, reset, home again",
    11: "(grblHAL) homing required: run $H",
    12: "(grblHAL) a limit switch is touching: move off it",
    13: "(grblHAL) probe protection tripped: check the probe",
    14: "(grblHAL) spindle did not reach its speed: check the spindle",
    15: "(grblHAL) homing of the second motor failed: check both switches",
    16: "(grblHAL) power-on self test failed: check the controller",
    17: "(grblHAL) motor fault: check drives and power",
}

# After these the controller listens to nothing but a reset, not even to '?'.
CRITICAL_ALARMS = frozenset({1, 2, 10})
# After these machine coordinates mean nothing any more (reference/machines.md, 7.2).
POSITION_LOST_ALARMS = frozenset({1, 3, 6, 7, 8, 9, 10, 15, 16, 17})
# These leave the spindle as it was; with every other the firmware has stopped it.
SPINDLE_ON_ALARMS = frozenset({4, 5, 11, 12, 13})


def error_words(number: int) -> str:
    """Return `error:20 (G or M code not supported: ...)`."""
    return f"error:{number} ({ERRORS.get(number, 'not in the list of GRBL 1.1: see the manual of this controller')})"


def alarm_words(number: int) -> str:
    """Return `ALARM:2 (move would leave the travel ...)`."""
    return f"ALARM:{number} ({ALARMS.get(number, 'not in the list of GRBL 1.1: see the manual of this controller')})"
