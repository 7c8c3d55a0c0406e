"""A person's decisions about a lens, apart from the set-up for which it is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from optics.bench import Bench
from optics.finish import Finish

Method = Literal["transport", "paper"]
STEPS_FOR_FINISH = 24
"""Of the descent behind a finish: 16 show 0.1 dB less, 32 as much more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensSettings:
    """The optical task.

    skim_mm            : depth of the lens's highest point under Z0
    corrections        : passes that add to the aim the light that the simulation lacked
    min_radius_mm      : valleys tighter than a ball of this radius are filled; 0 leaves them
    vertices_per_pixel : heightfield vertices along the side of a pixel
    polish_steps       : steps of the descent on the picture's own error, after the corrections; 0 is none
    finish             : the finish after milling; the lens is always polished for it; None: no finish
    creases            : concave creases as sharp as the grid shows, on vertices twice as close: for black areas, and
                         for a lens that no ball has to cut. min_radius_mm then does not apply
    """

    bench: Bench
    skim_mm: float
    method: Method = "transport"
    corrections: int = 2
    min_radius_mm: float = 0.0
    vertices_per_pixel: int = 2
    polish_steps: int = 0
    finish: Finish | None = None
    creases: bool = False

    def vertices(self, pixels: int) -> int:
        """Return the number of heightfield vertices along a side of that many pixels."""
        return (2 if self.creases else 1) * self.vertices_per_pixel * pixels + 1

    @property
    def descent_steps(self) -> int:
        """Steps of the descent; a lens for a finish has some even without polish."""
        return self.polish_steps if self.finish is None else max(self.polish_steps, STEPS_FOR_FINISH)

    @property
    def closing_radius_mm(self) -> float:
        """Radius of the ball that must fit; 0 if none has to."""
        return 0.0 if self.creases else self.min_radius_mm
