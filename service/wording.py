"""Format numbers, durations and scores for a person, on paper, on the page and on a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import floor
from typing import Any

from cam.cutters import cutter_shape
from phrases.phrase import Phrase

MISSING = "\N{EN DASH}"


def number(value: Any, digits: int = 3, unit: str = "") -> str:
    """Round to `digits` decimals without trailing zeros; return a dash for None."""
    if value is None or isinstance(value, str):
        return MISSING if value is None else value
    text = f"{value:.{digits}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    text = text.replace("-", "\N{MINUS SIGN}") if text not in ("-0", "0") else "0"
    return f"{text} {unit}".rstrip()


def align(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of one length as lines of a terminal, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def whole(value: Any) -> str:
    """Write 1234567 as 1 234 567, with spaces that do not break."""
    return MISSING if value is None else f"{round(value):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def duration(seconds: Any) -> str:
    """Write 40 s, 12 min, 1 h 45 min, from a day on 2 d 3 h, as on the operator page."""
    if seconds is None:
        return MISSING
    if (whole_s := _round_half_up(float(seconds))) < 60:
        return f"{whole_s} s"
    if (minutes := _round_half_up(whole_s / 60)) < 60:
        return f"{minutes} min"
    if minutes < 24 * 60:
        return _pair(minutes // 60, "h", minutes % 60, "min")
    hours = _round_half_up(minutes / 60)
    return _pair(hours // 24, "d", hours % 24, "h")


def _pair(big: int, big_unit: str, small: int, small_unit: str) -> str:
    return f"{big} {big_unit} {small} {small_unit}" if small else f"{big} {big_unit}"


def _round_half_up(value: float) -> int:
    """Round halves up."""
    return floor(value + 0.5)


def ball(radius_mm: float) -> str:
    """Return a ball's size: its radius as in the spec, its diameter as on its box."""
    return f"R {radius_mm:g} (Ø {2 * radius_mm:g} mm)"


def shape_of(row: Mapping[str, Any]) -> str:
    """Return the shape of a pass's end mill: from the row, or from the radius of its corner."""
    if (said := row.get("tool")) is not None:
        return str(said)
    return cutter_shape(row.get("radius_mm") or 1.0, row.get("corner_radius_mm")).name


def cutter(row: Mapping[str, Any]) -> Phrase:
    """Return a pass's end mill by shape and size."""
    size = "R ?" if row.get("radius_mm") is None else ball(row["radius_mm"])
    if (shape := shape_of(row)) == "bull-nose":
        return Phrase("bull-nose {size}, corner R {corner_mm:g} mm", size=size, corner_mm=row["corner_radius_mm"])
    named = {"flat": Phrase("flat {size}", size=size), "ball": Phrase("ball {size}", size=size)}
    return named.get(shape, Phrase("{shape} {size}", shape=shape, size=size))


def size(count: Any) -> str:
    """Return bytes in the largest unit that keeps the figure above 1."""
    if count is None:
        return MISSING
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"


RECOGNISABLE_DB = 9.0
"""Below, a picture is hard to recognise."""


def likeness_in_words(seen_db: float | None) -> Phrase:
    """Describe `optics.metrics.seen_db` in dB, None in old reports; the page has the same words, `job/eye_words.js`."""
    if seen_db is None:
        return Phrase("not known")
    for at_least, words in (
        (50.0, Phrase("no eye can tell it from the target")),
        (36.0, Phrase("very close to the target")),
        (27.0, Phrase("small differences, seen only side by side")),
        (16.0, Phrase("plainly the picture; fine detail or tones are off")),
        (RECOGNISABLE_DB, Phrase("recognisable, visibly soft or uneven")),
    ):
        if seen_db >= at_least:
            return words
    return Phrase("hard to recognise")


def describe_misplaced(share: float) -> Phrase:
    """Describe the share of light that falls on the wrong place as "one part in N"."""
    if share < 1e-4:
        return Phrase("all light falls where it should")
    if share > 1 / 3:
        return Phrase("a third of the light or more falls where it should not")
    return Phrase("about 1 part in {parts:.0f} of the light falls where it should not", parts=1 / share)
