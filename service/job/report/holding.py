"""How the block is held, in one answer: clamps on the ring that no cutter reaches, or nothing on its top at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from phrases.phrase import Phrase
from service.wording import number

CLAMP_MM = 8.0  # that a clamp needs to stand on
CLEARANCE_MM = 2.0  # free length beyond the deepest cut, so that the holder stays out of the block
_UNDER_RAPIDS_MM = 1.0  # what stands on the bed ends so far below the rapid moves
_BESIDE_WITNESS_MM = 8.0  # a ball of 6 mm and its shank
_JAWS_MM = 5.0  # of the block that a vice needs


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockSizes:
    """Sizes of a job's block in mm; deepest_mm is None before there is a lens, lamp_mm where light is parallel.

    outline_mm : corners of a lens that is no rectangle
    swept_mm   : left, right, front and back of what the cutter's flanks go over; None before there are programs
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
        """Width of the block's top that no cutter touches, at its narrowest; None of it: below 0."""
        return self.margin_mm if self.swept_mm is None else self.ring_beside_mm(self.swept_mm)

    def ring_beside_mm(self, swept_mm: tuple[float, float, float, float]) -> float:
        """Return the same beside what only some programs go over."""
        left, right, front, back = swept_mm
        return self.margin_mm - max(-left, right - self.width_mm, -front, back - self.height_mm)

    @property
    def has_room_for_clamps(self) -> bool:
        """Whether clamps find room on that ring."""
        return self.swept_mm is not None and self.ring_mm >= CLAMP_MM


@dataclass(frozen=True, slots=True, kw_only=True)
class Holding:
    """What the setup sheet says of it.

    sentences        : for the list under the drawing
    clearance_mm     : how far above the stock top the holder stays at the deepest cut
    highest          : nothing may stand higher than this: words
    """

    sentences: tuple[Phrase, ...]
    clearance_mm: float
    highest: Phrase


def plan_holding(
    block: BlockSizes | None, lows: Sequence[tuple[float, float]], rapid_z_mm: float | None, *, faced: bool = False
) -> Holding:
    """Plan it from the ring that programs leave.

    lows       : of each program, (ring that it leaves, lowest Z) [mm]
    rapid_z_mm : at which rapid moves cross; None where that is not known
    faced      : the whole top is milled, from beside the block
    """
    under_rapids_mm = CLEARANCE_MM if rapid_z_mm is None else rapid_z_mm - _UNDER_RAPIDS_MM
    clamped = block is not None and block.has_room_for_clamps
    clearance_mm = max(CLEARANCE_MM, under_rapids_mm) if clamped else CLEARANCE_MM
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
        yield Phrase("The clamps in the drawing are those of stock.clamps: every program was checked against them.")
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
    wide_mm = number(block.margin_mm + CLAMP_MM - block.ring_mm, 1)
    wider = Phrase(
        "{held}; stock.margin_mm = {margin_mm} leaves a ring that can be clamped.", held=held, margin_mm=wide_mm
    )
    yield Phrase("{held}.", held=held) if faced else wider
