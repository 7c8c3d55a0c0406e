"""What a section of docs/paper.md is, and what its tables have in common."""

from __future__ import annotations

from typing import NamedTuple

from tests.paper.cases import SIDE_MM, Result

CLAIMED_STEPS = (1, 3, 5, 7, 25)


class Sizes(NamedTuple):
    """Pixels a side: of the main picture (Figs 4 to 8), of the others (Fig. 9), of those remeshed (Fig. 12).

    milled_mm : side of the piece of the lens that Figs 13 and 14 mill, and of the whole lens of Fig. 15
    """

    main: int
    others: int
    remeshed: int
    milled_mm: float = SIDE_MM


class Section(NamedTuple):
    """One figure: its line of the table at the top (figure | claim | ours), and its text."""

    verdict: str
    text: str


TABLE = "| PSNR | SSIM | misplaced | contrast | relief | CPU |\n|---|---|---|---|---|---|---|"


def scores(result: Result) -> str:
    s = result.score
    return (
        f"{s.psnr_db:.1f} dB | {s.ssim:.3f} | {100 * s.misplaced_light:.1f} % | {100 * result.contrast:.0f} % | "
        f"{result.heightfield.relief_mm:.1f} mm | {result.cpu_s:.0f} s"
    )
