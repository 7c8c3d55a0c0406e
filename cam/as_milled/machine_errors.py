"""Errors of a machine: heights that are off by one value a row, or wander along an unbroken path (paper, Fig. 15c); and
screws, on which an axis goes a little too far and too short once in every turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cam.moves import Array
from cam.passes import PassSpec

WANDER_MM = 10.0
"""Along a path without entries the error keeps for about this way: that of a heavy axis, not that of chatter. A guess,
and a harmless one: rows of a 1 mm ball at pitch 0.05 mm over 16 mm, 0.5 µm of noise. Against the light of the design
22.5, 22.6, 22.7 dB for 5, 10, 20 mm (22.9 without noise, 22.5 with one error a row), slopes across 19.4, 18.8, 17.9
mrad (14.5, 19.5); along the path 1.9, 1.4, 1.1 mrad.
"""

SEED = 20140511


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Gaussian errors of the tip's height, the same for the same seed.

    sigma_mm  : standard deviation
    rows_run  : "x" or "y": each row of that direction has an error of its own (a collision at its beginning that is
                carried along, as in the paper); None: an error that is new at every entry and wanders along the path
    wander_mm : way after which a wandering error has forgotten 63 % of itself
    """

    sigma_mm: float
    rows_run: str | None = "x"
    wander_mm: float = WANDER_MM
    seed: int = SEED

    @classmethod
    def of_pass(cls, spec: PassSpec, sigma_mm: float, *, seed: int = SEED) -> Noise:
        return cls(sigma_mm=sigma_mm, rows_run=spec.direction if spec.strategy == "raster" else None, seed=seed)

    def errors_mm(self, tips_mm: Array, joined: NDArray[np.bool_]) -> Array:
        """Return (n,) height errors of tips (n, 3) as programmed."""
        rng = np.random.default_rng(self.seed)
        if self.rows_run is None:
            out: Array = rng.standard_normal(joined.size)
            _wander(tips_mm, joined, self.wander_mm, out)
            return self.sigma_mm * out
        number = _row_numbers(tips_mm[:, 1 if self.rows_run == "x" else 0], joined)
        return np.asarray(self.sigma_mm * rng.standard_normal(int(number[-1]) + 1 if number.size else 0)[number])


def _row_numbers(across_mm: Array, joined: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return row numbers (n,) of tips: each stretch of equal `across_mm` is a row; what lies between two goes with the
    one before.
    """
    along = np.zeros(across_mm.size, dtype=np.bool_)
    along[1:] = joined[1:] & (np.diff(across_mm) == 0.0)
    begins = along.copy()
    begins[1:] &= ~along[:-1]
    number = np.cumsum(begins)
    number[:-1] += begins[1:]  # the first tip of a row comes before its first chord
    return np.maximum(number, 0)


@njit(cache=True, nogil=True)
def _wander(tips: Array, joined: NDArray[np.bool_], wander: float, out: Array) -> None:
    """Turn independent unit normals into an Ornstein-Uhlenbeck walk of unit variance along each chain, in place."""
    for k in range(joined.size):
        if joined[k]:
            way = math.hypot(tips[k, 0] - tips[k - 1, 0], tips[k, 1] - tips[k - 1, 1])
            kept = math.exp(-way / wander)
            out[k] = kept * out[k - 1] + math.sqrt(1.0 - kept * kept) * out[k]


_PER_TURN = 16  # pieces of a chord, so that it follows the wave


@dataclass(frozen=True, slots=True, kw_only=True)
class Screws:
    """Triples are X, Y, Z.

    error_mm : amplitude of the error of an axis
    lead_mm  : way of the axis in a turn of its screw
    """

    error_mm: tuple[float, float, float]
    lead_mm: tuple[float, float, float]

    @property
    def longest_mm(self) -> float:
        """How long a chord may be in plan that still follows the waves of X and Y, and of Z on slopes up to 1."""
        leads = [lead for error, lead in zip(self.error_mm, self.lead_mm, strict=True) if error > 0]
        return min(leads, default=math.inf) / _PER_TURN

    def errors_mm(self, tips_mm: Array) -> Array:
        """Return by how much tips (n, 3) are off; where in its turn a screw stands at zero is not known: at its own."""
        return np.asarray(np.array(self.error_mm) * np.sin(2.0 * np.pi * tips_mm / np.array(self.lead_mm)))
