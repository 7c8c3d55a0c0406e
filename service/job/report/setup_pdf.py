"""setup-sheet.pdf: one page of A4 for use beside the mill, with the setup sheet's instructions to its operator.

Theory of operation: its contents come from `describe_setup`, and its sentences are those of the HTML page. They run
down two columns in the largest type that fits; before the type gets too small, the side view is left out. It has no
date and no figure that depends on the computer, so that the same job gives the same bytes. It is in English only:
another language would cost half a second of computing, and the fonts have no Japanese.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import escape

from service.job.files import table
from service.job.report.figures.a4_sheet import (
    HEIGHT,
    INK,
    WIDTH,
    Paper,
    Word,
    replace_missing,
    width_of,
    words_of,
    wrap,
)
from service.job.report.setup_sheet import in_language, render_block
from service.wording import MISSING, duration, number, shape_of, whole

SHOWN = {
    "finish-tolerance.png": 3, "caustic-as-finished.png": 1, "caustic-as-milled.png": 1, "caustic.png": 1,
    "target.png": 1,
}  # fmt: skip
"""Pictures of the wall in order of preference, and how many pictures each shows side by side."""

_EDGE, _GAP = 34.0, 16.0
_COLUMN = (WIDTH - 2 * _EDGE - _GAP) / 2
_PICTURE, _SMALL_PICTURE = 92.0, 74.0  # one alone, and each in a row
_RED, _GREEN, _SOFT = "#b3261e", "#1b6e3c", "#5b6b7a"
_LARGE, _SMALL, _SMALLEST = 9.5, 7.5, 6.0
_LEADING = 1.24
_COLUMNS = (
    ("", 14.0), ("program, in this order", 143.0), ("diameter", 52.0), ("end mill", 68.0), ("stick-out", 47.0),
    ("rpm", 38.0), ("feed, plunge", 58.0), ("time", 58.0), ("SHA-256", 49.28),
)  # fmt: skip
_LEFT_COLUMNS = 4
_MOST_ROW = 15.0


@dataclass(frozen=True, slots=True)
class _Line:
    words: list[Word]
    mark: str = ""
    is_title: bool = False
    is_loud: bool = False


def render_setup_pdf(setup: Mapping[str, Any], picture: bytes | None, *, beside: int = 1) -> bytes:
    """Return the page.

    setup : from `describe_setup`     picture : PNG of what the wall will show     beside : pictures in it, in a row
    """
    setup, paper, title = in_language(setup, "en"), Paper(), f"Setup sheet: {setup['title']}"
    top = _draw_head(paper, setup, title, picture, beside)
    top = _draw_programs(paper, setup["passes"], top) + _GAP
    _draw_columns(paper, setup, top)
    return paper.render_pdf(replace_missing(title))


def _draw_head(paper: Paper, setup: Mapping[str, Any], title: str, picture: bytes | None, beside: int) -> float:
    """Draw name, facts, verdict, and the picture at the right; return where the rest begins."""
    right = WIDTH - _EDGE
    if picture is not None:
        side = _PICTURE if beside == 1 else _SMALL_PICTURE
        right = paper.draw_picture(picture, right, _EDGE, side, beside=beside) - _GAP
    y = _EDGE
    verdict = {"good": _GREEN, "bad": _RED}.get(setup["verdict"][0], INK)
    parts = (
        (title, 18.0, 1, INK, True),
        (render_block("head", setup), 9.0, 2, _SOFT, False),
        (render_block("verdict", setup).replace("<li>", " "), 10.0, 3, verdict, False),
    )
    for text, size, most, colour, bold in parts:
        words = [(word, bold) for word in text.split()] if bold else words_of(text)
        for words_of_line in _at_most(list(wrap(words, right - _EDGE, size)), most):
            y += 1.2 * size
            paper.write_line(_EDGE, y, words_of_line, size, colour)
        y += 4
    return max(y, _EDGE + (0 if picture is None else _PICTURE)) + 10


def _at_most(lines: list[list[Word]], most: int) -> list[list[Word]]:
    if len(lines) <= most:
        return lines
    *others, (word, bold) = lines[most - 1]
    return [*lines[: most - 1], [*others, (f"{word[:-2]}…", bold)]]


def _draw_programs(paper: Paper, passes: Sequence[Mapping[str, Any]], top: float) -> float:
    """Draw the table of programs; return its lower end."""
    if not passes:
        return top
    rows = [[title for title, _ in _COLUMNS], *map(_cells, passes)]
    height = min(_MOST_ROW, 300.0 / len(rows))
    for k, cells in enumerate(rows):
        x, base = _EDGE, top + (k + 0.72) * height
        if k % 2:
            paper.draw_box(_EDGE, top + k * height, WIDTH - 2 * _EDGE, height, facecolor="#eef2f6", edgecolor="none")
        for at, (words, (_, width)) in enumerate(zip(cells, _COLUMNS, strict=True)):
            left, strong = at < _LEFT_COLUMNS, k > 0 and at in (1, 2)
            wanted = 7.5 if k == 0 else min(9.5, 0.66 * height)
            size = min(wanted, wanted * (width - 5) / max(width_of(words, strong, wanted), 1.0))
            look: dict[str, Any] = {"bold": strong, "colour": INK if k else _SOFT, "anchor": "start" if left else "end"}
            paper.write(x if left else x + width, base, words, size, **look)
            x += width
    return top + len(rows) * height


def _cells(row: Mapping[str, Any]) -> list[str]:
    """Return a program's row of the table: a box to tick, its file, tool, figures, and the beginning of its hash."""
    parts = row.get("parts") or [row]
    first, last = parts[0], parts[-1]
    files = str(row.get("file") or MISSING)
    radius_mm = row.get("radius_mm")
    kind = shape_of({"tool": "flat", **row} if row["is_around"] else row)
    feeds = f"{whole(row.get('feed_mm_per_min'))}, {whole(row.get('plunge_mm_per_min'))}"
    hashes = [str(one.get("sha256") or MISSING)[:8] for one in ((first,) if first is last else (first, last))]
    return [
        "☐",
        files if first is last else f"{files} to {last.get('file')}",
        f"Ø {number(2 * radius_mm)} mm" if radius_mm else MISSING,
        f"{kind}, R {number(radius_mm)}" + (f", Z{row['flutes']}" if row.get("flutes") else "")
        if radius_mm
        else MISSING,
        str(row.get("stick_out") or MISSING),
        whole(row.get("spindle_rpm")),
        feeds,
        duration(row.get("time_s")),
        " … ".join(hashes),
    ]


def _draw_columns(paper: Paper, setup: Mapping[str, Any], top: float) -> None:
    """Draw the block and, below and beside it, all text."""
    for views, size, most, is_full in _tries(setup):
        below = top + sum(map(_height, views))
        lines = list(_lines(setup, size, most, is_full=is_full))
        first, second = (int((HEIGHT - _EDGE - start) / (_LEADING * size)) for start in (below, top))
        split = _fill(lines, first)
        if len(lines) <= split + second:
            break
    for k, view in enumerate(views):
        paper.draw_svg(view, _EDGE, top + sum(map(_height, views[:k])), _scale(view))
    _write(paper, lines[:split], _EDGE, below, size)
    _write(paper, lines[split : split + second], _EDGE + _COLUMN + _GAP, top, size)


def _tries(setup: Mapping[str, Any]) -> Iterator[tuple[list[str], float, int, bool]]:
    """Yield (views, size of the type, number of warnings, all about the work by hand), from the best layout to the most
    compact.
    """
    views, count = [str(setup[name]) for name in ("top_view", "side_view") if setup[name]], len(_warnings(setup))
    for is_full in (True, False):
        yield from ((views, size, count, is_full) for size in _sizes(_LARGE, _SMALL))
        yield from ((views[:1], size, count, is_full) for size in _sizes(_LARGE, _SMALL))
    yield from ((views[:1], _SMALL, most, False) for most in range(count - 1, -1, -1))
    yield from ((views[:1], size, 0, False) for size in _sizes(_SMALL, _SMALLEST))


def _sizes(largest: float, smallest: float) -> list[float]:
    return [largest - 0.25 * k for k in range(int(4 * (largest - smallest)) + 1)]


def _fill(lines: Sequence[_Line], room: int) -> int:
    """Return the number of lines in the first column, which never ends with a title."""
    split = min(room, len(lines))
    while 0 < split < len(lines) and lines[split - 1].is_title:
        split -= 1
    return max(split, 0)


def _size(view: str) -> tuple[float, float]:
    width, height = view.split('viewBox="0 0 ')[1].split('"')[0].split()
    return float(width), float(height)


def _scale(view: str) -> float:
    return _COLUMN / max(_size(view)[0], 400.0)


def _height(view: str) -> float:
    return _scale(view) * _size(view)[1]


def _write(paper: Paper, lines: Sequence[_Line], x: float, top: float, size: float) -> None:
    for k, line in enumerate(lines):
        y = top + (k + 0.85) * _LEADING * size
        if line.mark:
            paper.write(x, y, line.mark, size, bold=line.is_loud, colour=_RED if line.is_loud else INK)
        indent, colour = (0.0, _RED if line.is_loud else INK) if line.is_title else (1.3 * size, INK)
        paper.write_line(x + indent, y, line.words, size, colour)


def _lines(setup: Mapping[str, Any], size: float, most: int, *, is_full: bool) -> Iterator[_Line]:
    """Yield all text in lines."""
    for title, mark, items in _sections(setup, most, is_full=is_full):
        is_loud = mark == "!"
        if items:
            yield from () if title == "Warnings" else (_Line([]),)
            yield _Line([(word, True) for word in title.split()], is_title=True, is_loud=is_loud)
        for item in items:
            for k, words in enumerate(wrap(words_of(item), _COLUMN - 1.3 * size, size)):
                yield _Line(words, "" if k else mark, is_loud=is_loud)


def _sections(setup: Mapping[str, Any], most: int, *, is_full: bool) -> list[tuple[str, str, list[str]]]:
    """Return (title, mark before each sentence, sentences as HTML)."""
    warnings = _warnings(setup)
    more = [f"{len(warnings) - most} more on the setup sheet, report.html."] if most < len(warnings) else []
    return [
        ("Warnings", "!", [*map(escape, warnings[:most]), *more]),
        ("Stock and zero", "•", _items("stock", setup) if setup["block"] else []),
        ("Before you press start", "☐", _items("start", setup)),
        ("Where to go on after a break", "•", _restart_sentences(setup)),
        ("Around the passes", "•", [*map(escape, setup["around"])]),
        ("Finishing by hand", "•", [*map(escape, _finish_sentences(setup, is_full=is_full))]),
    ]


def _restart_sentences(setup: Mapping[str, Any]) -> list[str]:
    """Return how to go on after a break, and for each program its lines with the tool's place and the words in
    force.
    """
    listed = []
    for file, rows in setup["restarts"]:
        listed.append(f"<strong>{escape(file)}</strong>")
        listed += [f"line {row[0]}: {row[3]} Z {row[4]}, {row[5]}, {row[6]}" for row in rows]
    return [render_block("restart", setup), *listed] if listed else []


def _finish_sentences(setup: Mapping[str, Any], *, is_full: bool) -> list[str]:
    """Return the sentences for the work: the tolerance of the finish, the tool at the rims, how to read the witness
    marks; where there is room, what is needed, the steps, and when to stop before them.
    """
    card = setup["finishing"] or {}
    if is_full and card:
        figures = [f"{what}: {figure}" for what, figure in card["rows"]]
        work = [
            card["title"],
            *figures,
            *card["needs"],
            *card["steps"],
            *filter(None, [card["when_to_stop"]]),
            *card["donts"],
        ]
        return [*work, *_finish_sentences(setup, is_full=False)]
    witness = card.get("witness") or {"rows": [], "sentences": []}
    rows = [f"{when}: {what}" for when, what in witness["rows"]]
    return [*card.get("tolerance", ()), *card.get("rims", ()), *witness["sentences"], *rows]


def _warnings(setup: Mapping[str, Any]) -> list[str]:
    """Return the warnings that matter at the mill, without those about picture and lens."""
    of_lens = table(setup["report"].get("warnings_by_part")).get("optics") or ()
    return [one for one in setup["warnings"] if one not in of_lens]


def _items(block: str, setup: Mapping[str, Any]) -> list[str]:
    return render_block(block, setup).split("<li>")[1:]
