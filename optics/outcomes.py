"""From milled heights to their possible pictures: the forward model on which the descent optimises a lens.

E = sum over outcomes of weight x 1/2 sum over pixels of (I - T)^2. An outcome is a finish as it may turn out: no one
hits k0 exactly, and a lens made for one exact finish loses 6 dB if the work is a quarter too short or too long. I is
the light of the finished surface by flux tubes.

A pad bridges the creases that make black. Its removal is far from linear there and depends on every height nearby. So
`touch` computes the exact finish of the lens at intervals; in between, the model is the linear law for heights mirrored
at the rims, plus what contact and run-out added to it at the last touch. A descent would then deepen dark creases until
the pad leaves them, and they show as black shards with bright edges. So E also penalises each place where the linear
law takes off less than a tenth of the mean, and less than at the last touch. (`chelsea`, 60 mm, felt: 25.3 dB without
it, 25.9 with it, 24.8 and 26.5 after too little work.) Heights are not changed where the pad bridges, nor at the rims:
the run-out extends the slope there over millimetres, and with that lever a descent would bend the outermost vertices,
where no ball fits, instead of the lens. (`camera`, 256 pixels, linear tone, sanding, k0 2.56: 25.0 dB, SSIM 0.76
without the descent and 28.0, 0.85 with it; 25.7 in the worst of its outcomes.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optics.bench import Bench
from optics.contact import transform, transform_back, weigh_nodes
from optics.finish import Finish, finish_lens, level
from optics.heightfield import Array, Heightfield
from optics.spline import Mask
from optics.tubes.picture import TubePicture

DESIGN_BEAMS = 7  # of an extended light, while a lens is designed for it
_OFF_K0, _OFF_ORDER = (0.8, 1.25), (0.75, 1.25)  # times the plan: the spread of finishing by hand
_OFF_WEIGHT = 0.15  # of each of them
_LEAST_OFF = 0.1  # of the mean removal, that a pad has to take off everywhere
_UNPRESSED = 30.0  # weight of the squared lack of it, per vertex, in the unit of E; 10 and 100 give the same result


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """A finish as it may turn out, and how much its picture counts. finish: None if nothing is finished"""

    weight: float
    finish: Finish | None


def outcomes_of(finish: Finish | None) -> list[Outcome]:
    """Return the possible outcomes of a finish, the planned one first."""
    if finish is None:
        return [Outcome(weight=1.0, finish=None)]
    others = [finish.after(share**-finish.order) for share in _OFF_K0]
    others += [replace(finish, order=share * finish.order) for share in _OFF_ORDER]
    planned = Outcome(weight=1.0 - _OFF_WEIGHT * len(others), finish=finish)
    return [planned, *(Outcome(weight=_OFF_WEIGHT, finish=one) for one in others)]


class FinishedHeights:
    """A lens's heights after each of several finishes, and the transpose of that map.

    lens : its axes and run-out. finishes : None leaves the heights as they are
    """

    def __init__(self, lens: Heightfield, finishes: Sequence[Finish | None]) -> None:
        self._lens, self._finishes = lens, finishes
        shape, spacing = lens.z_mm.shape, (lens.dy_mm, lens.dx_mm)
        self._kept = [None if one is None else one.multipliers(shape, spacing) for one in finishes]
        self._left: list[Array | float] = [0.0] * len(finishes)  # added by run-out and contact to the linear law
        self._least: list[Array | float] = [0.0] * len(finishes)  # removal over its mean that each vertex has to keep
        self._lacks: list[Array | float] = [0.0] * len(finishes)  # of it
        self._nodes = weigh_nodes(shape)
        self._is_unfinished = all(kept is None for kept in self._kept)

    def of(self, z_mm: Array) -> list[Array]:
        """Return (ny, nx) heights after each finish."""
        if self._is_unfinished:
            return [z_mm] * len(self._kept)
        waves, surfaces = transform(z_mm), []
        for number, (finish, kept, left) in enumerate(zip(self._finishes, self._kept, self._left, strict=True)):
            if finish is None or kept is None:
                surfaces.append(z_mm)
                continue
            levelled = transform_back(waves * kept, z_mm.shape)
            if finish.depth_mm is not None:
                off = _divide_removal(z_mm, levelled, finish.depth_mm)
                self._lacks[number] = np.minimum(off - self._least[number], 0.0)
            surfaces.append(levelled + left)
        return surfaces

    def weigh_lacks(self) -> list[float]:
        """Return for each finish the cost of the vertices that the pad does not press at the last heights."""
        return [0.5 * _UNPRESSED * float(np.square(lack).sum()) for lack in self._lacks]

    def touch(self, z_mm: Array) -> Mask:
        """Recompute the terms of run-out and contact; return where the first finish's pad bridges: (ny, nx) of bool."""
        lens, hangs = replace(self._lens, z_mm=z_mm), np.zeros(z_mm.shape, dtype=np.bool_)
        for number, (finish, kept) in enumerate(zip(self._finishes, self._kept, strict=True)):
            if finish is None or kept is None:
                continue
            done = finish_lens(lens, finish)
            levelled = level(z_mm, kept)
            self._left[number] = done.lens.z_mm - levelled
            if finish.depth_mm is not None:
                self._least[number] = np.minimum(_divide_removal(z_mm, levelled, finish.depth_mm), _LEAST_OFF)
            if number == 0:
                hangs = ~done.touched
        return hangs

    def transpose(self, gains: Sequence[Array], weights: Sequence[float]) -> Array:
        """Return (ny, nx) the gradient with respect to the heights, from the gradients after each finish and
        `weigh_lacks`.
        """
        by_heights, waves = np.zeros_like(self._nodes), np.zeros_like(self._nodes)
        each = zip(self._finishes, self._kept, self._lacks, gains, weights, strict=True)
        for finish, kept, lack, gain, weight in each:
            if finish is None or kept is None:
                by_heights += gain
                continue
            unpressed = 0.0 if finish.depth_mm is None else weight * _UNPRESSED / finish.depth_mm * lack
            by_heights += unpressed
            waves += kept * transform((gain - unpressed) / self._nodes)
        if self._is_unfinished:
            return by_heights
        return np.asarray(by_heights + self._nodes * transform_back(waves, waves.shape))


def _divide_removal(z_mm: Array, levelled_mm: Array, depth_mm: float) -> Array:
    """Return (ny, nx) the removal by the linear law, over its mean."""
    return np.asarray((z_mm - levelled_mm) / depth_mm + 1.0)


class MeanError:
    """E of heights, with that many tubes per cell side.

    Behind a finish it uses the mean colour: there white light blurs `camera` less than the finish itself. (256 pixels,
    felt, k0 2.05: white scores 0.1 dB more than one wavelength, whether the descent saw white or not.)

    `touch`, then `of`, then the gradient at the same heights
    """

    def __init__(
        self, lens: Heightfield, target: Array, bench: Bench, outcomes: Sequence[Outcome], tubes_per_cell: int
    ) -> None:
        self.target, self.outcomes = target, outcomes
        self._finished = FinishedHeights(lens, [one.finish for one in outcomes])
        if any(one.finish is not None for one in outcomes):
            bench = bench.spare_colours()
        self.tubes = [
            TubePicture(lens, bench, pixels=target.shape, tubes_per_cell=tubes_per_cell, beams=DESIGN_BEAMS)
            for _ in outcomes
        ]
        self.misses = [target] * len(outcomes)
        self._per_vertex = target.size / lens.z_mm.size

    def touch(self, z_mm: Array) -> Mask:
        """Recompute where the pads touch; return where that of the first outcome bridges: (ny, nx) of bool."""
        return self._finished.touch(z_mm)

    def of(self, z_mm: Array) -> float:
        """Return E of heights (ny, nx)."""
        surfaces = self._finished.of(z_mm)
        self.misses = [
            tubes.picture(surface) - self.target for tubes, surface in zip(self.tubes, surfaces, strict=True)
        ]
        each = zip(self.outcomes, self.misses, self._finished.weigh_lacks(), strict=True)
        return sum(one.weight * (0.5 * float((miss**2).sum()) + self._per_vertex * lack) for one, miss, lack in each)

    def gradient(self) -> Array:
        """Return dE/dz (ny, nx) at the last heights."""
        each = zip(self.outcomes, self.tubes, self.misses, strict=True)
        gains = [one.weight * tubes.gain(miss) for one, tubes, miss in each]
        return self._finished.transpose(gains, [self._per_vertex * one.weight for one in self.outcomes])

    def psnr_db(self) -> float:
        """Return the PSNR of the first outcome at the last heights."""
        error = float((self.misses[0] ** 2).sum())
        return float(10 * np.log10(self.target.max() ** 2 * self.target.size / max(error, 1e-300)))
