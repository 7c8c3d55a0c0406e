"""What the check of each program found, in numbers, for the setup sheet: one row per question, one column per pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import ceil
from typing import Any

from cam.rows.entries import RAMP_DEG
from service.wording import MISSING, number, whole

Row = Mapping[str, Any]
Cells = tuple[str, str, list[str]]

_SCRATCH_MM = 0.5  # shorter slots are not worth a word


def check_rows(passes: Sequence[Row]) -> list[Cells]:
    """Return (what was verified, what is allowed, one cell per pass); rows that no pass has an answer to are left
    out.
    """
    asked: tuple[tuple[str, str, Callable[[Row], str | None]], ...] = (
        ("Program read back and cut in simulation", "every move", lambda p: _unit(p, "moves", whole, "moves")),
        ("Cut below the lens", "1 µm, or 1.5 steps of the heights written", lambda p: _number(p, "gouge_um", 2, "µm")),
        ("Deepest bite", "the step-down and the cusps before", _bite),
        ("Rapid moves in stock, or across below the safe height", "none", _none),
        ("Straight down into stock; spindle off in stock", "none", _none),
        ("Widest gap between tracks", "1.5 row distances, 1.02 for contour", _gap),
        ("Stock left above what the pass leaves, where the ball reaches", "cusps, 5 µm and a quarter of it", _excess),
        ("Shank and end of flutes against stock that stands", "no contact", _shank),
        ("Extent within the mill's travel", "travel of each axis", _extent),
        (f"Entries, on ramps of {RAMP_DEG:g}° or in air", "", lambda p: _unit(p, "entries", whole, "")),
        ("Cut climbing, by volume", "", lambda p: _percent(p, "climb_share")),
        ("Cut at the ball's full width", "deep ones at half the feed", _slots),
        ("Along the contour lines (within 15°)", "", lambda p: _percent(_part(p, "contour"), "aligned_share")),
        ("Places gone over, of a rest pass", "", _rest),
        (
            "Left above Z0 by the facing, or in the slot of the cut-out",
            "cusps",
            lambda p: _number(p, "left_um", 1, "µm"),
        ),
        ("Between the cutter and the lens, cutting it out", "0", lambda p: _number(p, "clear_um", 1, "µm")),
        ("Tabs that hold the lens", "as asked", _tabs),
    )
    rows = []
    for what, allowed, answer in asked:
        cells = [answer(row) if row.get("checked") else None for row in passes]
        if any(cell is not None for cell in cells):
            rows.append((what, allowed, [MISSING if cell is None else cell for cell in cells]))
    return rows


def flutes_in_words(row: Row) -> str:
    """Return how long the flutes must be and, where that is stated, are."""
    need_mm, have_mm = row.get("flute_need_mm"), row.get("flute_length_mm")
    if need_mm is None:
        return MISSING
    at_least = f"{ceil(10 * need_mm) / 10:g} mm"
    return at_least if have_mm is None else f"{at_least} (has {have_mm:g})"


def order_in_words(row: Row) -> str:
    """Return how the tool goes over the lens in a pass."""
    if row.get("is_around"):
        return "rows along X over the whole top" if "above_mm" in row else "around the lens, layer by layer"
    if row.get("strategy") == "contour":
        return "one path along the contour lines"
    if row.get("pitch_mm") is None:
        return ""
    rows = f"rows along {str(row.get('direction', 'x')).upper()}"
    rows += ", one way" if row.get("link") == "retract" else ", there and back"
    return f"{rows}, only where the ball before left stock" if row.get("where") == "rest" else rows


def _part(row: Row, key: str) -> Row:
    value = row.get(key)
    return value if isinstance(value, Mapping) else {}


def _number(row: Row, key: str, digits: int, unit: str) -> str | None:
    return None if row.get(key) is None else number(row[key], digits, unit)


def _unit(row: Row, key: str, words: Callable[[Any], str], unit: str) -> str | None:
    return None if row.get(key) is None else f"{words(row[key])} {unit}".rstrip()


def _percent(row: Row, key: str) -> str | None:
    return None if row.get(key) is None else f"{100 * row[key]:.0f} %"


def _none(row: Row) -> str | None:
    return "none" if row.get("checked") == "passed" else None


def _bite(row: Row) -> str | None:
    if row.get("max_engagement_mm") is None:
        return None
    bite = number(row["max_engagement_mm"], 3)
    return f"{bite} of {number(row['step_down_mm'], 3)} mm" if row.get("step_down_mm") else f"{bite} mm"


def _gap(row: Row) -> str | None:
    if row.get("max_gap_mm") is None:
        return None
    gap = number(row["max_gap_mm"], 4)
    return f"{gap} at {number(row['pitch_mm'], 4)} mm" if row.get("pitch_mm") else f"{gap} mm"


def _excess(row: Row) -> str | None:
    return _number(row, "excess_um", 1, "µm")


def _shank(row: Row) -> str | None:
    if row.get("checked") != "passed":
        return None
    return "none" if row.get("flute_length_mm") else "not stated"


def _extent(row: Row) -> str | None:
    bounds = _part(row, "bounds")
    if row.get("checked") != "passed" or not all(len(bounds.get(axis) or ()) == 2 for axis in "xyz"):
        return None
    return " × ".join(number(bounds[axis][1] - bounds[axis][0], 1) for axis in "xyz") + " mm"


def _slots(row: Row) -> str | None:
    if row.get("slot_length_mm") is None:
        return None
    if row["slot_length_mm"] < _SCRATCH_MM:
        return "nowhere"
    return f"{number(row['slot_length_mm'], 0)} mm, {number(row.get('slot_depth_mm'), 2)} mm deep"


def _rest(row: Row) -> str | None:
    rest = _part(row, "rest")
    if not rest:
        return None
    places = f"{rest.get('regions', 0):.0f} place{'' if rest.get('regions') == 1 else 's'}"
    return f"{places}, {number(rest.get('area_mm2'), 1)} mm²"


def _tabs(row: Row) -> str | None:
    tabs = row.get("tabs")
    if not isinstance(tabs, list):
        return None
    heights = [tab["height_mm"] for tab in tabs]
    return f"{len(heights)}, {number(min(heights), 2)} to {number(max(heights), 2)} mm high"
