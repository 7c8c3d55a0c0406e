"""One sheet of A4 to draw on: running text, pictures, and the line drawings of the setup sheet from their SVG.

Lengths are points, y grows downward, (x, y) of a text is its base line. The same calls give the same bytes.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, get_font
from matplotlib.patches import FancyArrowPatch, PathPatch, Polygon
from matplotlib.path import Path as Curve
from matplotlib.textpath import text_to_path
from PIL import Image

WIDTH, HEIGHT = 595.28, 841.89
INK = "#1f2933"
_FONTS = [Path(matplotlib.get_data_path(), f"fonts/ttf/DejaVuSans{kind}.ttf") for kind in ("", "-Bold")]
_SPACE = 0.348  # of the size of the type, that of bold
_POINTS = {"M": 1, "L": 1, "C": 3, "Z": 0}
_CODES = {"M": Curve.MOVETO, "L": Curve.LINETO, "C": Curve.CURVE4}

Word = tuple[str, bool]
"""A word and its weight (bold or not)."""


class Paper:
    """The sheet; later drawings lie on top of earlier ones."""

    def __init__(self) -> None:
        self._figure = Figure(figsize=(WIDTH / 72, HEIGHT / 72), dpi=72)
        self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0), autoscale_on=False)
        self._axes.axis("off")
        self._order = 0

    def render_pdf(self, title: str) -> bytes:
        """Return the PDF file, without a date, with fonts from which text can be copied."""
        self._axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        buffer = io.BytesIO()
        with matplotlib.rc_context({"pdf.fonttype": 42}):
            metadata = {"Title": title, "CreationDate": None}
            self._figure.savefig(buffer, format="pdf", metadata=metadata)
        return buffer.getvalue()

    def write(
        self, x: float, y: float, words: str, size: float, *, bold: bool = False, colour: str = INK,
        anchor: str = "start", turned_deg: float = 0.0,
    ) -> None:  # fmt: skip
        align = {"start": "left", "middle": "center", "end": "right"}[anchor]
        self._axes.text(
            x, y, replace_missing(words), fontproperties=_font(bold, size), color=colour, ha=align, va="baseline",
            rotation=turned_deg, rotation_mode="anchor", parse_math=False, zorder=self._take_order(),
        )  # fmt: skip

    def write_line(self, x: float, y: float, words: Sequence[Word], size: float, colour: str = INK) -> None:
        """Write words of one line."""
        start = 0
        for end in range(1, len(words) + 1):
            bold = words[start][1]
            if end == len(words) or words[end][1] != bold:
                run = " ".join(word for word, _ in words[start:end])
                self.write(x, y, run, size, bold=bold, colour=colour)
                x += width_of(run, bold, size) + _SPACE * size
                start = end

    def draw_polygon(self, points: Sequence[tuple[float, float]], **look: Any) -> None:
        self._axes.add_patch(Polygon(points, zorder=self._take_order(), **look))

    def draw_box(self, x: float, y: float, width: float, height: float, **look: Any) -> None:
        self.draw_polygon([(x, y), (x + width, y), (x + width, y + height), (x, y + height)], **look)

    def draw_arrow(self, start: tuple[float, float], end: tuple[float, float], style: str, **look: Any) -> None:
        arrow = FancyArrowPatch(start, end, arrowstyle=style, shrinkA=0, shrinkB=0, zorder=self._take_order(), **look)
        self._axes.add_patch(arrow)

    def draw_curve(self, path: Curve, **look: Any) -> None:
        self._axes.add_patch(PathPatch(path, zorder=self._take_order(), **look))

    def draw_picture(self, png: bytes, right: float, top: float, side: float, *, beside: int = 1) -> float:
        """Draw a picture in the upper right of a square; return its left edge. beside: number of equally large pictures
        in a row in it.
        """
        with Image.open(io.BytesIO(png)) as opened:
            shown = opened.convert("L")
        shown.thumbnail((300 * beside, 300))
        wide, high = (side * one / max(shown.width / beside, shown.height) for one in shown.size)
        place = (right - wide, right, top + high, top)
        levels = np.asarray(shown)
        self._axes.imshow(levels, cmap="gray", vmin=0, vmax=255, extent=place, aspect="auto", interpolation="none")
        return right - wide

    def draw_svg(self, drawing: str, x: float, y: float, scale: float) -> None:
        """Draw the block of `service.job.report.block`."""
        for node in fromstring(drawing):
            _Drawn(self, x, y, scale).draw(node)

    def _take_order(self) -> int:
        self._order += 1
        return self._order


class _Drawn:
    """Draws the elements of an SVG in their place on the sheet."""

    def __init__(self, paper: Paper, x: float, y: float, scale: float) -> None:
        self._paper, self._scale = paper, scale
        self._origin = np.array([x, y])

    def draw(self, node: Element) -> None:
        get = node.attrib
        match node.tag:
            case "rect":
                x, y, w, h = (float(get[key]) for key in ("x", "y", "width", "height"))
                self._paper.draw_polygon(self._at([(x, y), (x + w, y), (x + w, y + h), (x, y + h)]), **self._look(get))
            case "polygon":
                self._paper.draw_polygon(self._at(_numbers(get["points"])), **self._look(get))
            case "circle":
                turn = np.linspace(0, 2 * np.pi, 25)
                around = float(get["r"]) * np.column_stack([np.cos(turn), np.sin(turn)])
                centre = float(get["cx"]), float(get["cy"])
                self._paper.draw_polygon(self._at(centre + around), **self._look(get))
            case "line":
                self._draw_line(get)
            case "path":
                self._paper.draw_curve(self._curve(get["d"]), **self._look(get))
            case "text":
                self._write_text(node, (float(get["x"]), float(get["y"])), 0.0)
            case "g":
                self._write_text(node[0], _numbers(get["transform"].split(")")[0].partition("(")[2])[0], 90.0)

    def _at(self, points: object) -> list[tuple[float, float]]:
        placed = self._origin + self._scale * np.asarray(points, dtype=float)
        return [(float(x), float(y)) for x, y in placed]

    def _look(self, get: Mapping[str, str]) -> dict[str, Any]:
        fill, width = get.get("fill", "none"), self._scale * float(get.get("stroke-width", 1.0))
        dashes = [self._scale * one / width for one in map(float, get.get("stroke-dasharray", "").split())]
        look: dict[str, Any] = {"facecolor": fill, "edgecolor": get.get("stroke", "none"), "linewidth": width}
        if fill.startswith("url"):
            look |= {"facecolor": "none", "edgecolor": "#5b6b7a", "linewidth": 0.0, "hatch": "//////"}
        return look | ({"linestyle": (0, tuple(dashes))} if dashes else {})

    def _draw_line(self, get: Mapping[str, str]) -> None:
        start, end = self._at([(float(get[f"x{k}"]), float(get[f"y{k}"])) for k in (1, 2)])
        style = ("<|" if "marker-start" in get else "") + "-" + ("|>" if "marker-end" in get else "")
        look = self._look(get) | {"facecolor": get["stroke"], "mutation_scale": 11 * self._scale}
        self._paper.draw_arrow(start, end, style, **look)

    def _curve(self, steps: str) -> Curve:
        points: list[tuple[float, float]] = []
        codes: list[np.uint8] = []
        for kind, numbers in re.findall(r"([MLCZ])([^MLCZ]*)", steps):
            points += _numbers(numbers) if kind != "Z" else points[:1]
            codes += [_CODES[kind]] * _POINTS[kind] if kind != "Z" else [Curve.CLOSEPOLY]
        return Curve(self._at(points), codes)

    def _write_text(self, node: Element, at: tuple[float, float], turned_deg: float) -> None:
        [(x, y)], get = self._at([at]), node.attrib
        look: dict[str, Any] = {"colour": get["fill"], "anchor": get["text-anchor"]}
        self._paper.write(x, y, node.text or "", self._scale * float(get["font-size"]), turned_deg=turned_deg, **look)


def _numbers(text: str) -> list[tuple[float, float]]:
    found = [float(one) for one in re.findall(r"-?[\d.]+", text)]
    return list(zip(found[::2], found[1::2], strict=True))


def words_of(html: str) -> list[Word]:
    """Return the words of a piece of HTML, with those in <strong> bold; of other tags only the text."""
    words: list[Word] = []
    glue = False
    for k, piece in enumerate(re.split(r"</?strong>", html)):
        text = str(Markup(piece).striptags())
        new = [(word, k % 2 == 1) for word in text.split(" ") if word]
        if new and words and glue and not piece[0].isspace():  # a full stop after a bold word
            words[-1] = (words[-1][0] + new.pop(0)[0], words[-1][1])
        words += new
        glue = bool(piece) and not piece[-1].isspace()
    return words


def wrap(words: Sequence[Word], width: float, size: float) -> Iterator[list[Word]]:
    """Yield lines no wider than `width`; a word that is wider is broken."""
    line: list[Word] = []
    left = width
    for word in (part for whole in words for part in _break(whole, width, size)):
        needs = width_of(*word, size)
        if line and needs > left:
            yield line
            line, left = [], width
        line.append(word)
        left -= needs + _SPACE * size
    if line:
        yield line


def _break(word: Word, width: float, size: float) -> Iterator[Word]:
    text, bold = word
    while width_of(text, bold, size) > width and len(text) > 1:
        fits = max(1, int(len(text) * width / width_of(text, bold, size)) - 1)
        yield text[:fits], bold
        text = text[fits:]
    yield text, bold


def replace_missing(text: str) -> str:
    """Return the text with a box in place of each character that the font lacks."""
    marks = _characters()
    return "".join(one if ord(one) in marks else "\N{WHITE SQUARE}" for one in text)


@lru_cache
def _characters() -> frozenset[int]:
    """Return the characters of both fonts."""
    regular, bold = (frozenset(get_font(str(path)).get_charmap()) for path in _FONTS)
    return regular & bold


def width_of(text: str, bold: bool, size: float) -> float:
    """Return the width of a text."""
    return size * _ems(text, bold)


@lru_cache(maxsize=8192)
def _ems(text: str, bold: bool) -> float:
    wide, _, _ = text_to_path.get_text_width_height_descent(replace_missing(text), _font(bold, 100.0), ismath=False)
    return float(wide) / 100.0


def _font(bold: bool, size: float) -> FontProperties:
    return FontProperties(fname=str(_FONTS[bold]), size=size)
