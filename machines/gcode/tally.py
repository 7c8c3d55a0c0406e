"""Indices of the vectors that a scan fills: totals, events, bounds. Plain numbers, for the kernel and its readers."""

from __future__ import annotations

# Totals over the program.
(
    LINES, BLOCKS, PATH_MM, CUT_MM, SENT_BYTES, LEAST_FEED, MOST_FEED, LEAST_RPM, MOST_RPM, MOTIONS, LAST_Z,
    LAST_MACHINE_Z, LONGEST_PAUSE_S,
) = range(13)  # fmt: skip
TOTALS = 13
# LAST_Z: where the last motion ends, nan if that is in machine coordinates: then LAST_MACHINE_Z, inf at home.
# Events: the first line of each, and how many.
(
    UNITS_ASSUMED, DISTANCE_ASSUMED, SPINDLE_OFF, BLIND_CUT, BLIND_RELATIVE, FRAME_MOVED, SETTINGS_WRITTEN, STOPS,
    OVER_RATE, PLACE_UNKNOWN, MACHINE_MOVES, MIST, NUMBERED,
) = range(13)  # fmt: skip
EVENTS = 13
# Rows of the bounds: G54 .. G59, then after the program moved its frame, then machine coordinates.
SHIFTED_ROW, MACHINE_ROW, FRAMES = 6, 7, 8
# Rules of the dialect, as numbers.
(
    RULE_LENGTH, RULE_N, RULE_PERCENT, RULE_LETTERS, RULE_TWO_DIGITS, RULE_POINT, RULE_DECIMALS, RULE_SPINDLE, RULE_G53,
    RULE_BARE_ZERO, RULE_NAME_LEAST, RULE_NAME_MOST, RULE_NAMED, RULE_NO_R,
) = range(14)  # fmt: skip
