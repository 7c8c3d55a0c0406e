"""The way in: from where the tool is parked to the first place that a program gives in X, Y and Z.

When a program begins, the position of the tool and the obstacles around the block are not known. Only one path is safe
from anywhere: straight up to the top of the mill or to the safe height, then across, then down. If the place of the
tool is known, a way above the milled area is safe, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from math import inf
from typing import NamedTuple

from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState, Step
from machines.gcode.text import split_words, strip_block
from machines.preflight.preflight import Bounds
from phrases.phrase import Phrase

MOST_LINES = 10_000
"""Bytes of a program that are searched for all three coordinates: a tenth of a second."""

WAY_IN = "way-in"
"""Name of the rule."""

_AT_TOP_MM = 5.0  # a head counts as raised within this distance below its top
_REPORTED_MM = 0.01  # half a step and the digits of a report


class Motion(NamedTuple):
    """One step on the way in. axes : those of "XYZ" that it moves; all if it goes home without naming an axis"""

    line: int
    step: Step
    axes: str


class WayIn(NamedTuple):
    """The steps until X, Y and Z are given. frame : of the first step in work coordinates, "G54" ..., "shifted" """

    motions: tuple[Motion, ...]
    frame: str


def read_way_in(lines: Iterable[tuple[int, bytes]], *, dialect: str, state: ModalState | None = None) -> WayIn:
    """Read the beginning of a program in G-code that pre-flight accepts. state : what is known before it begins"""
    interpreter = Interpreter(state, dialect=dialect)
    motions: list[Motion] = []
    given, frame = set[str](), ""
    for number, text in islice(lines, MOST_LINES):
        step = interpreter.take(text)
        if not step.moves:
            continue
        named = {letter.decode() for letter, _ in split_words(strip_block(text))}
        axes = "".join(axis for axis in "XYZ" if axis in named) or "XYZ" * step.goes_home
        motions.append(Motion(number, step, axes))
        if step.machine_mm is None and not step.goes_home:
            given |= {axis for axis, end in zip("XYZ", step.end_mm, strict=True) if axis in axes and end is not None}
            frame = frame or ("shifted" if interpreter.state.shifted else interpreter.state.wcs)
        if len(given) == 3:
            break
    return WayIn(tuple(motions), frame)


def read_from_place(
    lines: Sequence[tuple[int, bytes]], *, dialect: str, wcs: str, place_mm: tuple[float, float, float]
) -> WayIn:
    """Read the way in of a tool at a known position of the work frame `wcs`."""
    return read_way_in(lines, dialect=dialect, state=replace(ModalState(), wcs=wcs, position_mm=place_mm))


def find_risk(
    motions: Iterable[Motion], *, safe_z_mm: float, top_z_mm: float | None, over: Bounds | None = None
) -> Phrase | None:
    """Return, in words, which step may hit a clamp or the block; None if the way is safe.

    safe_z_mm : in the work frame; a way across is no lower
    top_z_mm  : machine Z of the raised head; None: 0
    over      : the milled area, if the tool's position is known: above it a rapid may be lower than safe_z_mm
    """
    raised, placed = False, set[str]()
    for line, step, axes in motions:
        begin = _height(step.start_mm[2], raised=raised)
        end = begin
        if "Z" in axes:
            if step.goes_home:
                end = inf
            elif step.machine_mm is not None:
                end = inf if is_raised(step.machine_mm[2], top_z_mm) else -inf
            else:
                end = _height(step.end_mm[2], raised=False)
            raised = end == inf
        across = any(
            axis in axes and (a is None or b is None or abs(b - a) > _REPORTED_MM)
            for axis, a, b in zip("XY", step.start_mm, step.end_mm, strict=False)
        )
        lowest = min(begin, end)
        if over is not None:
            inside = _is_over(over, step.start_mm) and _is_over(over, step.end_mm)
            if across and step.kind == "rapid" and lowest < safe_z_mm and not (inside and lowest >= -_REPORTED_MM):
                return _say_across(line, lowest, safe_z_mm)
            if not across and end < begin - _REPORTED_MM and not inside and not placed.issuperset("XY"):
                x, y, _ = step.start_mm
                return Phrase(
                    "line {line} goes to Z{to_mm:g}, and the tool stands at X{x_mm:.1f} Y{y_mm:.1f} Z{z_mm:.1f}: "
                    "that is straight down beside what the program mills; bring the tool over the block, or down "
                    "to that height",
                    line=line,
                    to_mm=end,
                    x_mm=x,
                    y_mm=y,
                    z_mm=begin,
                )
        elif across and lowest < safe_z_mm:
            return _say_across(line, lowest, safe_z_mm)
        elif "Z" in axes and end < safe_z_mm and None in step.start_mm[:2] and not placed.issuperset("XY"):
            return _say_low(line, end, safe_z_mm)
        placed |= set(axes)
    return None


def is_raised(machine_z_mm: float | None, top_z_mm: float | None) -> bool:
    """Return whether a height in machine coordinates is at the top of the mill, as far as it is known."""
    return machine_z_mm is not None and machine_z_mm >= (top_z_mm or 0.0) - _AT_TOP_MM


def _say_across(line: int, lowest_mm: float, safe_z_mm: float) -> Phrase:
    if lowest_mm == -inf:
        return Phrase(
            "line {line} goes across from a height that nobody knows, and may hit a clamp or the block; begin with Z "
            "alone: up to Z{safe_z_mm:g} or higher, or to the top of the mill (G53 G0 Z)",
            line=line,
            safe_z_mm=safe_z_mm,
        )
    return Phrase(
        "line {line} goes across at Z{lowest_mm:g} before X, Y and Z are given, and may hit a clamp or the block; "
        "begin with Z alone: up to Z{safe_z_mm:g} or higher, or to the top of the mill (G53 G0 Z)",
        line=line,
        lowest_mm=lowest_mm,
        safe_z_mm=safe_z_mm,
    )


def _say_low(line: int, end_mm: float, safe_z_mm: float) -> Phrase:
    if end_mm == -inf:
        return Phrase(
            "line {line} first moves to a height that may be too low; begin with Z alone: up to Z{safe_z_mm:g} "
            "or higher, or to the top of the mill (G53 G0 Z)",
            line=line,
            safe_z_mm=safe_z_mm,
        )
    return Phrase(
        "line {line} goes to Z{end_mm:g}, below the safe height Z{safe_z_mm:g}, from an unknown place; begin with Z "
        "alone: up to that or higher, or to the top of the mill (G53 G0 Z)",
        line=line,
        end_mm=end_mm,
        safe_z_mm=safe_z_mm,
    )


def _height(z_mm: float | None, *, raised: bool) -> float:
    """Return a height in the work frame; inf: at the top of the mill, -inf: not known."""
    return z_mm if z_mm is not None else inf if raised else -inf


def _is_over(box: Bounds, place: Sequence[float | None]) -> bool:
    return all(
        value is not None and least is not None and most is not None and least <= value <= most
        for value, least, most in zip(place[:2], box.least_mm, box.most_mm, strict=False)
    )
