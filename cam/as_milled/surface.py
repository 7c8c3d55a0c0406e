"""The milled surface as a whole: parts that can be made one by one, in any order, by any thread."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cam.as_milled.chords import Chords, sorted_chords
from cam.as_milled.facets import facets_of
from cam.as_milled.strips import Fineness
from cam.as_milled.tracks import Tracks
from cam.moves import Array
from optics.heightfield import Heightfield

CHORDS_PER_PART = 20_000
_LONGEST_MM = 0.1  # half a pixel of 512 on 100 mm
_BOX_MM = 0.03  # smaller ones cost more memory than they save time
_SIGMAS = 3.0
_EVEN = 0.7  # of the pitch: roughness that hides less than this hides no track (6 sigma), it only bends borders
_PIECE, _SHORTEST_MM = 0.12, 0.005  # parts of a strip where tracks come and go: of what the roughness hides
_SHARE = 0.1  # of its chord, where that is shorter: the ends of such parts decide how much area there is
_BEND = 0.05  # of the pitch: borders of facets


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MilledSurface:
    """What finishing programs leave, as facets: `part(0)` .. `part(parts - 1)`.

    reach_mm : balls farther apart than this do not hide anything of one another
    """

    chords: Chords
    lens: tuple[Array, float, float, float, float]
    reach_mm: float
    fine: Fineness

    @classmethod
    def of_tracks(
        cls,
        tracks: Sequence[Tracks],
        heightfield: Heightfield,
        *,
        pitch_mm: float,
        error_mm: float = 0.0,
        roughness_mm: float = 0.0,
    ) -> MilledSurface:
        """Of one program or several: a point belongs to the ball that went deepest there.

        pitch_mm     : the widest distance between neighbouring tracks
        error_mm     : standard deviation of the tips' heights. One that lies d deeper hides others sqrt(2 R d) around.
        roughness_mm : what of it changes from tip to tip, as that of steps does: then a track comes and goes
        """
        radius = max(one.radius_mm for one in tracks)
        hidden, patchy = (math.sqrt(2.0 * radius * _SIGMAS * error) for error in (error_mm, roughness_mm))
        reach = 1.5 * pitch_mm + 1.5 * hidden
        even = patchy < _EVEN * pitch_mm
        shortest = _LONGEST_MM if even else max(_PIECE * patchy, _SHORTEST_MM)
        return cls(
            chords=sorted_chords([one.divided(_LONGEST_MM) for one in tracks], side_mm=max(reach, _BOX_MM)),
            lens=heightfield.spline_with_run_out(radius + 1.0).kernel_arguments,
            reach_mm=reach,
            fine=Fineness(
                longest=_LONGEST_MM,
                crossed=pitch_mm / 6,
                shortest=shortest,
                share=1.0 if even else _SHARE,
                bend=_BEND * pitch_mm,
            ),
        )

    @property
    def parts(self) -> int:
        return math.ceil(self.chords.joined.size / CHORDS_PER_PART)

    def part(self, number: int) -> Array:
        """(n, 4, 5) facets: corners in order around, each x, y, z [mm] and slopes in x and y."""
        first = number * CHORDS_PER_PART
        last = min(first + CHORDS_PER_PART, self.chords.joined.size)
        return np.asarray(facets_of(self.chords, first, last, self.lens, self.reach_mm, self.fine))
