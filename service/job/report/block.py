"""The block on the mill: how it is held (by clamps on the ring that no cutter reaches, or without clamps), and the two
line drawings of the setup sheet as inline SVG, from above and from the side.

Only numbers and our own words go into the drawings, so they are safe to place in the page as they are. Each is one
phrase, so that another language can say its words. `setup_pdf` draws the same elements.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from cam.checking.envelope import ABOVE_CLAMPS_MM, CLAMP_GRIP_MM, NOSE_CLEARANCE_MM
from phrases.phrase import Phrase, join
from service.wording import number

_UNDER_RAPIDS_MM = ABOVE_CLAMPS_MM  # distance of objects on the bed below the rapid moves
_BESIDE_WITNESS_MM = 8.0  # a ball of 6 mm and its shank
_JAWS_MM = 5.0  # of the block that a vice needs

_ROOM_FOR_WORDS = 110.0
_BLOCK, _LENS, _ACCENT = "#dfe8f0", "#ffffff", "#b3261e"


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockSizes:
    """Sizes of a job's block in mm; deepest_mm is None before there is a lens, lamp_mm where light is parallel.

    outline_mm : corners of a lens that is not a rectangle
    swept_mm   : left, right, front and back of the area that the cutter's flanks sweep; None before there are programs
    clamps_mm  : left, front, width and depth of each that the spec names
    witness_mm : left, right, front and back of the strip of witness marks
    """

    width_mm: float
    height_mm: float
    thickness_mm: float
    margin_mm: float
    throw_mm: float
    deepest_mm: float | None = None
    is_mirror: bool = False
    lamp_mm: float | None = None
    outline_mm: Sequence[Sequence[float]] = ()
    swept_mm: tuple[float, float, float, float] | None = None
    clamps_mm: Sequence[tuple[float, float, float, float]] = ()
    witness_mm: tuple[float, float, float, float] | None = None

    @property
    def ring_mm(self) -> float:
        """Least width of the block's top that no cutter touches; below 0 if there is none."""
        return self.margin_mm if self.swept_mm is None else self.ring_beside_mm(self.swept_mm)

    def ring_beside_mm(self, swept_mm: tuple[float, float, float, float]) -> float:
        """Return the same width beside an area that only some programs cover."""
        left, right, front, back = swept_mm
        return self.margin_mm - max(-left, right - self.width_mm, -front, back - self.height_mm)

    @property
    def has_room_for_clamps(self) -> bool:
        """Whether the ring has room for clamps."""
        return self.swept_mm is not None and self.ring_mm >= CLAMP_GRIP_MM


@dataclass(frozen=True, slots=True, kw_only=True)
class Holding:
    """The setup sheet's part on holding the block.

    sentences        : for the list under the drawing
    clearance_mm     : how far above the stock top the holder stays at the deepest cut
    highest          : the height above which nothing may stand, in words
    """

    sentences: tuple[Phrase, ...]
    clearance_mm: float
    highest: Phrase


def plan_holding(
    block: BlockSizes | None, lows: Sequence[tuple[float, float]], rapid_z_mm: float | None, *, faced: bool = False
) -> Holding:
    """Plan the holding from the ring that programs leave.

    lows       : of each program, (ring that it leaves, lowest Z) [mm]
    rapid_z_mm : at which rapid moves cross; None if that is not known
    faced      : the whole top is milled, from beside the block
    """
    under_rapids_mm = NOSE_CLEARANCE_MM if rapid_z_mm is None else rapid_z_mm - _UNDER_RAPIDS_MM
    clamped = block is not None and block.has_room_for_clamps
    clearance_mm = max(NOSE_CLEARANCE_MM, under_rapids_mm) if clamped else NOSE_CLEARANCE_MM
    highest_mm = min(clearance_mm, under_rapids_mm)
    sentences: tuple[Phrase, ...]
    if block is None or block.swept_mm is None:
        sentences = (Phrase("outside the area that the cutters sweep."),)
    else:
        sentences = (
            _describe_sweep(block.swept_mm),
            *_describe_witness(block.witness_mm),
            *_describe_holding(block, lows, highest_mm, faced),
        )
    highest = Phrase("{highest_mm} mm above the stock top", highest_mm=number(highest_mm))
    if faced:
        highest = Phrase("1 mm below the faced top")
    return Holding(sentences=sentences, clearance_mm=clearance_mm, highest=highest)


def _describe_sweep(swept_mm: tuple[float, float, float, float]) -> Phrase:
    left, right, front, back = (number(one, 1) for one in swept_mm)
    return Phrase(
        "the cutters sweep X {left_mm} to {right_mm}, Y {front_mm} to {back_mm} mm, flanks included (dashed in the "
        "drawing).",
        left_mm=left,
        right_mm=right,
        front_mm=front,
        back_mm=back,
    )


def _describe_witness(witness_mm: tuple[float, float, float, float] | None) -> Iterator[Phrase]:
    if witness_mm is None:
        return
    left, right, front, back = (number(one, 1) for one in witness_mm)
    yield Phrase(
        "The witness marks are milled into the ring at X {left_mm} to {right_mm}, Y {front_mm} to {back_mm} mm (dotted "
        "in the drawing): no clamp stands there or within {clear_mm} mm of it.",
        left_mm=left,
        right_mm=right,
        front_mm=front,
        back_mm=back,
        clear_mm=number(_BESIDE_WITNESS_MM),
    )


def _describe_holding(
    block: BlockSizes, lows: Sequence[tuple[float, float]], highest_mm: float, faced: bool
) -> Iterator[Phrase]:
    if block.clamps_mm:
        yield Phrase("The clamps in the drawing are those of the job: every program was checked against them.")
    if block.has_room_for_clamps:
        yield Phrase(
            "Around it a ring {ring_mm} mm wide keeps the stock top: clamps stand there and nowhere else (hatched in "
            "the drawing), outside the dashed line and at most {highest_mm} mm high. For higher ones give a greater "
            "machine.safe_z_mm; the tools then stick out by as much more.",
            ring_mm=number(block.ring_mm, 1),
            highest_mm=number(highest_mm),
        )
        return
    narrow = block.ring_mm > 0
    lowest_mm = min([0.0, *(low_mm for ring_mm, low_mm in lows if narrow or ring_mm <= 0)])
    if narrow:
        yield Phrase(
            "No clamp on top: the ring around it is only {ring_mm} mm wide, and the cutters pass it down to Z "
            "{lowest_mm} mm.",
            ring_mm=number(block.ring_mm, 1),
            lowest_mm=number(lowest_mm, 1),
        )
    else:
        yield Phrase("That reaches the edge of the block: no clamp on top.")
    held = Phrase("Hold it from below (vacuum, wax or double-sided tape)")
    if block.thickness_mm + lowest_mm - _UNDER_RAPIDS_MM >= _JAWS_MM:
        held = Phrase(
            "Hold it from below (vacuum, wax or double-sided tape), or in a vice whose jaws stay below Z {jaws_mm} mm",
            jaws_mm=number(lowest_mm - 1, 1),
        )
    wide_mm = number(block.margin_mm + CLAMP_GRIP_MM - block.ring_mm, 1)
    wider = Phrase(
        "{held}; stock.margin_mm = {margin_mm} leaves a ring that can be clamped.", held=held, margin_mm=wide_mm
    )
    yield Phrase("{held}.", held=held) if faced else wider


def top_view(block: BlockSizes) -> Phrase:
    """Draw the block as the operator sees it from above, the front of the mill at the bottom."""
    block_w, block_h = block.width_mm + 2 * block.margin_mm, block.height_mm + 2 * block.margin_mm
    scale = 230.0 / max(block_w, block_h)
    left, top = 58.0, 14.0
    w, h, m = block_w * scale, block_h * scale, block.margin_mm * scale
    zero_x, zero_y = left + m, top + h - m
    arrow = min(60.0, 0.45 * min(w, h))
    parts = [
        _box(left, top, w, h, _BLOCK, "#5b6b7a"),
        *_hatch_for_clamps(block, left, top, w, h),
        *_swept(block, zero_x, zero_y, scale),
        *_witness(block, zero_x, zero_y, scale),
        *_lens(block, zero_x, zero_y, scale),
        *_clamps(block, zero_x, zero_y, scale),
        _arrow(zero_x, zero_y, zero_x + arrow, zero_y),
        _arrow(zero_x, zero_y, zero_x, zero_y - arrow),
        f'<circle cx="{zero_x:.1f}" cy="{zero_y:.1f}" r="4.5" fill="{_ACCENT}"/>',
        _text(zero_x + arrow + 4, zero_y - 5, "X", colour=_ACCENT),
        _text(zero_x + 6, zero_y - arrow + 4, "Y", colour=_ACCENT),
        _text(zero_x + 9, zero_y - 9, "X0 Y0", colour=_ACCENT),
        *_lens_size(block, left, top, w, h, m),
        _dimension_across(left, left + w, top + h + 16, Phrase("block {width_mm:g} mm", width_mm=block_w)),
        _dimension_up(left - 14, top, top + h, f"{block_h:g} mm"),
        _text(left + w / 2, top + h + 48, Phrase("front of the mill (operator)"), anchor="middle", colour="#66727f"),
    ]
    if block.margin_mm > 0:
        parts.append(
            _text(left + w + 6, top + h - m / 2 + 4, Phrase("margin {margin_mm:g}", margin_mm=block.margin_mm))
        )
    return _svg(left + 340, top + h + 58, Phrase("The block from above"), parts)


def _hatch_for_clamps(block: BlockSizes, left: float, top: float, w: float, h: float) -> list[str]:
    """Hatch where clamps may stand, or say that none may; the area that cutters sweep is drawn over it."""
    if block.swept_mm is None:
        return []
    if not block.has_room_for_clamps:
        return [_text(left + w + 6, top + h / 2, Phrase("no clamp on top"), colour=_ACCENT)]
    pattern = (
        '<defs><pattern id="clamps" width="7" height="7" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">'
        '<line x1="0" y1="0" x2="0" y2="7" stroke="#5b6b7a" stroke-width="1.6"/></pattern></defs>'
    )
    hatched = f'<rect x="{left:.1f}" y="{top:.1f}" width="{w:.1f}" height="{h:.1f}" fill="url(#clamps)"/>'
    return [pattern, hatched, _text(left + w + 6, top + h / 2, Phrase("clamps: hatched"))]


def _swept(block: BlockSizes, zero_x: float, zero_y: float, scale: float) -> list[str]:
    """Draw the area that the cutter's flanks sweep, if a ring is left around it."""
    if block.swept_mm is None or block.ring_mm <= 0:
        return []
    style = 'fill="#eef2f6" stroke="#8795a1" stroke-dasharray="4 3"'
    return [_rectangle(block.swept_mm, zero_x, zero_y, scale, style)]


def _witness(block: BlockSizes, zero_x: float, zero_y: float, scale: float) -> list[str]:
    """Draw the strip of witness marks, over the hatching of where clamps may stand."""
    if block.witness_mm is None:
        return []
    style = f'fill="#ffffff" stroke="{_ACCENT}" stroke-dasharray="1.5 2"'
    return [_rectangle(block.witness_mm, zero_x, zero_y, scale, style)]


def _rectangle(
    sides_mm: tuple[float, float, float, float], zero_x: float, zero_y: float, scale: float, style: str
) -> str:
    """Return a rectangle; sides_mm: left, right, front, back."""
    left, right, front, back = sides_mm
    box = f'x="{zero_x + scale * left:.1f}" y="{zero_y - scale * back:.1f}"'
    size = f'width="{scale * (right - left):.1f}" height="{scale * (back - front):.1f}"'
    return f"<rect {box} {size} {style}/>"


def _clamps(block: BlockSizes, zero_x: float, zero_y: float, scale: float) -> list[str]:
    """Draw the area of the block that the clamps named in the spec cover, and a little beside it."""
    out_mm = block.margin_mm + 4.0 / scale
    style = 'fill="#8795a1" stroke="#1f2933"'
    return [
        _rectangle(
            (
                max(x, -out_mm),
                min(x + width, block.width_mm + out_mm),
                max(y, -out_mm),
                min(y + depth, block.height_mm + out_mm),
            ),
            *(zero_x, zero_y, scale, style),
        )
        for x, y, width, depth in block.clamps_mm
        if -out_mm < x + width and x < block.width_mm + out_mm
        if -out_mm < y + depth and y < block.height_mm + out_mm
    ]


def _lens(block: BlockSizes, zero_x: float, zero_y: float, scale: float) -> list[str]:
    """Draw the aperture, and in it the outline of a lens that is not a rectangle."""
    w, h = scale * block.width_mm, scale * block.height_mm
    if not block.outline_mm:
        return [_box(zero_x, zero_y - h, w, h, _LENS, "#1f2933")]
    points = " ".join(f"{zero_x + scale * x:.1f},{zero_y - scale * y:.1f}" for x, y in block.outline_mm)
    return [
        f'<rect x="{zero_x:.1f}" y="{zero_y - h:.1f}" width="{w:.1f}" height="{h:.1f}" fill="none" stroke="#5b6b7a" '
        'stroke-width="0.8" stroke-dasharray="2 3"/>',
        f'<polygon points="{points}" fill="{_LENS}" stroke="#1f2933" stroke-width="1.4"/>',
    ]


def _lens_size(block: BlockSizes, left: float, top: float, w: float, h: float, m: float) -> tuple[str, str]:
    """Label the lens's size: in its middle if that is clear of the axes, else beside the block."""
    words = f"{block.width_mm:g} × {block.height_mm:g} mm"
    if min(w, h) - 2 * m > _ROOM_FOR_WORDS:
        x, y, anchor = left + w / 2, top + h / 2, "middle"
    else:
        x, y, anchor = left + w + 6, top + 30, "start"
    return _text(x, y - 18, Phrase("lens"), anchor=anchor), _text(x, y - 3, words, anchor=anchor)


def side_view(block: BlockSizes) -> Phrase:
    """Draw light through the block or onto the mirror, and to the wall. The distance to the wall is not to scale."""
    left, width, wall, zero, back = 70.0, 190.0, 28.0, 160.0, 226.0
    deepest = block.deepest_mm or 0.0
    depth = min(max(deepest / block.thickness_mm, 0.0), 0.95) * (back - zero)
    low, high = zero + depth, zero + 3
    inner = left + 16
    curve = (
        f"L{inner} {zero} L{inner} {high + 8:.1f} "
        f"C{inner + 40} {high:.1f} {inner + 55} {low:.1f} {inner + 85} {low:.1f} "
        f"C{inner + 115} {low:.1f} {inner + 130} {high:.1f} {left + width - 16} {high + 10:.1f} "
        f"L{left + width - 16} {zero}"
    )
    parts = [
        f'<path d="M{left} {zero} {curve} L{left + width} {zero} L{left + width} {back} L{left} {back} Z" '
        f'fill="{_BLOCK}" stroke="#5b6b7a"/>',
        f'<line x1="{left - 40}" y1="{wall}" x2="{left + width + 20}" y2="{wall}" stroke="#1f2933" stroke-width="4"/>',
        _text(left + width / 2, wall - 9, Phrase("wall or screen, parallel to the back"), anchor="middle"),
        f'<line x1="{left - 40}" y1="{zero}" x2="{left + width + 20}" y2="{zero}" stroke="{_ACCENT}" '
        f'stroke-dasharray="5 4"/>',
        _text(left + width + 24, zero + 4, Phrase("Z0 = stock top"), colour=_ACCENT),
        _dimension_up(left - 24, wall + 2, zero, Phrase("wall {throw_mm:g} mm", throw_mm=block.throw_mm)),
        _dimension_up(left - 24, zero, back, f"{block.thickness_mm:g} mm"),
        _text(left + width + 24, back + 4, Phrase("flat back") if block.is_mirror else Phrase("flat, polished back")),
        *_draw_light(block, left, width, zero, back),
        *(_ray(x, low - 4, x + shift, wall + 3) for x, shift in ((left + 45, 26), (left + 95, -6), (left + 150, -30))),
    ]
    if block.deepest_mm is not None:
        beside = min(max(low + 4, zero + 21), back - 14)  # clear of the labels of Z0 and of the back
        parts.append(_text(left + width + 24, beside, Phrase("deepest {deepest_mm:.2f} mm", deepest_mm=deepest)))
    return _svg(left + width + 150, back + 60, Phrase("The block, the light and the wall from the side"), parts)


def _draw_light(block: BlockSizes, left: float, width: float, zero: float, back: float) -> list[str]:
    """Draw arrows up to the back, or down to a mirror, spreading if they come from a lamp; and their label."""
    middle = left + width / 2
    spread = 1.0 if block.lamp_mm is None else 0.35
    low, high = (zero - 62, zero - 8) if block.is_mirror else (back + 34, back + 6)
    arrows = [_arrow(middle + spread * off, low, middle + off, high, colour="#c77700") for off in (-65.0, 0.0, 65.0)]
    source = Phrase("parallel light")
    if block.lamp_mm is not None:
        source = Phrase("lamp, {distance_mm:g} mm away", distance_mm=block.lamp_mm)
    if block.is_mirror:
        beside, colour = left + width + 24, "#8a5200"
        words = ((source, zero - 58), (Phrase("from the wall's side"), zero - 42))
        return [*arrows, *(_text(beside, y, line, colour=colour) for line, y in words)]
    square = Phrase("{light}, square to the back", light=source)
    return [*arrows, _text(middle, back + 50, square, anchor="middle", colour="#8a5200")]


def _svg(width: float, height: float, title: Phrase, parts: list[str]) -> Phrase:
    head = f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="'
    marker = (
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto-start-reverse"><path d="M0 0.5 L8 4 L0 7.5 Z" fill="context-stroke"/></marker></defs>'
    )
    return join("", (head, title, '">', marker, *parts, "</svg>"))


def _box(x: float, y: float, width: float, height: float, fill: str, stroke: str) -> str:
    return (
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" fill="{fill}" stroke="{stroke}" '
        f'stroke-width="1.4"/>'
    )


def _arrow(x0: float, y0: float, x1: float, y1: float, colour: str = _ACCENT) -> str:
    ends = f'x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="1.8" marker-end="url(#tip)"/>'


def _ray(x0: float, y0: float, x1: float, y1: float) -> str:
    ends = f'x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"'
    return f'<line {ends} stroke="#e0a040" stroke-width="1.2"/>'


def _text(x: float, y: float, words: str, *, anchor: str = "start", colour: str = "#1f2933") -> Phrase:
    look = f'text-anchor="{anchor}" fill="{colour}" font-size="12.5"'
    return join("", (f'<text x="{x:.1f}" y="{y:.1f}" {look}>', words, "</text>"))


def _dimension_across(x0: float, x1: float, y: float, words: str) -> Phrase:
    ends = f'x1="{x0:.1f}" y1="{y:.1f}" x2="{x1:.1f}" y2="{y:.1f}"'
    line = f'<line {ends} stroke="#66727f" marker-start="url(#tip)" marker-end="url(#tip)"/>'
    return join("", (line, _text((x0 + x1) / 2, y + 14, words, anchor="middle")))


def _dimension_up(x: float, y0: float, y1: float, words: str) -> Phrase:
    ends = f'x1="{x:.1f}" y1="{y0:.1f}" x2="{x:.1f}" y2="{y1:.1f}"'
    line = f'<line {ends} stroke="#66727f" marker-start="url(#tip)" marker-end="url(#tip)"/>'
    middle = (y0 + y1) / 2
    turned = f'{line}<g transform="translate({x - 6:.1f} {middle:.1f}) rotate(-90)">'
    return join("", (turned, _text(0, 0, words, anchor="middle"), "</g>"))
