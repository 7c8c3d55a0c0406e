"""The compiled reader of a line: bytes to code, code to words. The plain twin is in words.py."""

from __future__ import annotations

import numpy as np
from numba import njit

from machines.gcode import refusals, tally

MOST_CODE = 1024  # characters of code in a line, before any dialect's own limit


@njit(cache=True, nogil=True)
def read_code(raw, at, code):  # type: ignore[no-untyped-def]
    """Copy the line at `at` without comments and blanks, in upper case. Returns (its end, characters, refusal code).

    The end is -1 where it is not in raw.
    """
    p = at
    count = 0
    size = raw.size
    while p < size:
        c = raw[p]
        if c > 59:
            if 97 <= c <= 122:
                c -= 32
        elif c == 10:
            return p, count, 0
        elif c == 32 or c == 13 or (9 <= c <= 12):
            p += 1
            continue
        elif c == 59:
            while p < size and raw[p] != 10:
                p += 1
            continue
        elif c == 40:
            while p < size and raw[p] != 10 and raw[p] != 41:
                p += 1
            if p < size and raw[p] == 10:
                return p, count, refusals.OPEN_COMMENT
            p += 1
            continue
        if count >= MOST_CODE:
            return p, count, refusals.LONG
        code[count] = c
        count += 1
        p += 1
    return -1, count, 0


@njit(cache=True, nogil=True)
def read_words(code, size, rules, powers, values, g, m):  # type: ignore[no-untyped-def]
    """Words of a line's code. Returns (letters seen, as bits; G words; M words; refusal code)."""
    seen = 0
    n_g = 0
    n_m = 0
    q = 0
    strict = rules[tally.RULE_TWO_DIGITS] != 0 or rules[tally.RULE_POINT] != 0 or rules[tally.RULE_DECIMALS] < 17
    tapes = rules[tally.RULE_NAMED] + rules[tally.RULE_NAME_MOST] > 0
    while q < size:
        letter = int(code[q]) - 65
        if letter < 0 or letter > 25:
            return seen, n_g, n_m, _refuse_sign(code[q], rules)
        q += 1
        if letter == 14 and tapes:
            if q > 1 or not _is_name(code, size, rules):
                return seen, n_g, n_m, refusals.BAD_NAME
            return 1 << 14, n_g, n_m, 0
        q, value, digits, decimals = _read_number(code, size, q, powers)
        if digits == 0 or digits > 17:
            return seen, n_g, n_m, refusals.NO_NUMBER
        if letter == 6 or letter == 12:
            tenths = value * 10.0
            number = int(np.rint(tenths))
            if abs(tenths - number) > 1e-6 or number < 0 or n_g == 16 or n_m == 16:
                return seen, n_g, n_m, refusals.WRONG_G if letter == 6 else refusals.WRONG_M
            if strict and rules[tally.RULE_TWO_DIGITS] != 0 and (digits if decimals < 0 else digits - decimals) < 2:
                return seen, n_g, n_m, refusals.TWO_DIGITS
            if letter == 6:
                g[n_g] = number
                n_g += 1
            else:
                m[n_m] = number
                n_m += 1
            continue
        if not (rules[tally.RULE_LETTERS] >> letter) & 1:
            return seen, n_g, n_m, refusals.WRONG_LETTER
        if (seen >> letter) & 1:
            return seen, n_g, n_m, refusals.REPEATED
        if strict:
            bare = value != 0.0 or rules[tally.RULE_BARE_ZERO] == 0
            if decimals < 0 and (rules[tally.RULE_POINT] >> letter) & 1 and bare:
                return seen, n_g, n_m, refusals.NEEDS_POINT
            if decimals > rules[tally.RULE_DECIMALS]:
                return seen, n_g, n_m, refusals.DECIMALS
        seen |= 1 << letter
        values[letter] = value
    return seen, n_g, n_m, 0


@njit(cache=True, nogil=True)
def _refuse_sign(c, rules):  # type: ignore[no-untyped-def]
    if c == 37:
        return refusals.MISPLACED_PERCENT if rules[tally.RULE_PERCENT] else refusals.PERCENT
    if c == 36:
        return refusals.DOLLAR
    return refusals.BLOCK_DELETE if c == 47 else refusals.NO_LETTER


@njit(cache=True, nogil=True)
def _is_name(code, size, rules):  # type: ignore[no-untyped-def]
    """Whether the whole line is a program's name in this dialect: O and digits, or O and letters and digits."""
    named = rules[tally.RULE_NAMED] != 0
    least = 1 if named else rules[tally.RULE_NAME_LEAST]
    most = 16 if named else rules[tally.RULE_NAME_MOST]
    for k in range(1, size):
        if not (48 <= code[k] <= 57 or (named and 65 <= code[k] <= 90)):
            return False
    return least <= size - 1 <= most


@njit(cache=True, nogil=True, inline="always")
def _read_number(code, size, q, powers):  # type: ignore[no-untyped-def]
    """The number at q. Returns (behind it, value, digits, decimals: -1 without a point)."""
    negative = False
    if q < size and (code[q] == 45 or code[q] == 43):
        negative = code[q] == 45
        q += 1
    mantissa = 0
    digits = 0
    decimals = -1
    while q < size:
        c = code[q]
        if 48 <= c <= 57:
            mantissa = mantissa * 10 + (int(c) - 48)
            digits += 1
            if decimals >= 0:
                decimals += 1
        elif c == 46 and decimals < 0:
            decimals = 0
        else:
            break
        q += 1
    value = mantissa / powers[decimals] if decimals > 0 and decimals < powers.size else float(mantissa)
    return q, -value if negative else value, digits, decimals
