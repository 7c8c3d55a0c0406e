"""Anderson mixing: of the last steps of a fixed-point iteration, the combination with the least residual.

Residuals are stored in single precision, which halves the reading, and steps in the requested precision. The products
of the least squares are summed in double precision over pieces of fixed size, so that no result depends on the threads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from optics.spline import Array
from optics.threads import run_on_rows

_PIECE = 1 << 14
_SINGULAR = 1e-10  # of the normalised products: directions weaker than this are noise


@njit(cache=True, nogil=True)
def _remember(piece_lo: int, piece_hi: int, new: Array, last: Array, changes: Array, slot: int, is_first: bool) -> None:
    """Set changes[slot] = new - last and last = new on the pieces piece_lo..piece_hi - 1."""
    for k in range(piece_lo * _PIECE, min(piece_hi * _PIECE, new.size)):
        if not is_first:
            changes[slot, k] = new[k] - last[k]
        last[k] = new[k]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _fill_products(
    piece_lo: int, piece_hi: int, changes: Array, depth: int, slot: int, residual: Array, sums: Array
) -> None:
    """Compute sums[piece, 0, i] = changes[i] . changes[slot], sums[piece, 1, i] = changes[i] . residual per piece."""
    for piece in range(piece_lo, piece_hi):
        lo, hi = piece * _PIECE, min((piece + 1) * _PIECE, residual.size)
        newest, rest = changes[slot, lo:hi], residual[lo:hi]
        for i in range(depth):
            row = changes[i, lo:hi]
            by_newest = by_residual = 0.0
            for k in range(hi - lo):
                value = np.float64(row[k])
                by_newest += value * newest[k]
                by_residual += value * rest[k]
            sums[piece, 0, i], sums[piece, 1, i] = by_newest, by_residual


@njit(cache=True, nogil=True)
def _combine(piece_lo: int, piece_hi: int, moved: Array, weights: Array, moves: Array, mixed: Array) -> None:
    """Compute mixed = moved - sum of weights[i] * moves[i] on the pieces piece_lo..piece_hi - 1."""
    for piece in range(piece_lo, piece_hi):  # by elements: an array assigned to a slice takes 2 s to compile
        lo, hi = piece * _PIECE, min((piece + 1) * _PIECE, moved.size)
        out = mixed[lo:hi]
        for k in range(hi - lo):
            out[k] = moved[lo + k]
        for i in range(weights.size):
            row, weight = moves[i, lo:hi], weights[i]
            for k in range(hi - lo):
                out[k] -= weight * row[k]


class Anderson:
    """The last `depth` changes of iterate and residual; the residual has one further component, here the piston."""

    def __init__(self, size: int, depth: int, step_type: type[np.floating[Any]]) -> None:
        self.depth, self.pieces = depth, -(-size // _PIECE)
        self.moves = np.empty((depth, size), step_type)  # changes of x + f
        self.changes = np.empty((depth, size), np.float32)  # and of the residual
        self.extras = np.empty(depth)  # and of its further component
        self.gram = np.empty((depth, depth))
        self.last_moved, self.last_residual, self.last_extra = np.empty(size), np.empty(size, np.float32), 0.0
        self.sums = np.empty((self.pieces, 2, depth))
        self.count = -1  # changes so far

    def forget(self) -> None:
        self.count = -1

    def find_next(self, moved: Array, residual: Array, extra: float) -> Array:
        """Return the iterate after x, where moved = x + f(x) and the residual is that of x; arrays of any one shape."""
        flat, rest = moved.ravel(), residual.ravel()
        slot, is_first = max(self.count, 0) % self.depth, self.count < 0
        run_on_rows(_remember, self.pieces, flat, self.last_moved, self.moves, slot, is_first)
        run_on_rows(_remember, self.pieces, rest, self.last_residual, self.changes, slot, is_first)
        self.extras[slot], self.last_extra = extra - self.last_extra, extra
        self.count += 1
        if is_first:
            return moved
        weights = self._solve_weights(slot, rest, extra)
        mixed = np.empty_like(flat)
        run_on_rows(_combine, self.pieces, flat, weights, self.moves, mixed)
        return mixed.reshape(moved.shape)

    def _solve_weights(self, slot: int, residual: Array, extra: float) -> Array:
        n = min(self.count, self.depth)
        run_on_rows(_fill_products, self.pieces, self.changes, n, slot, residual, self.sums)
        by_newest, by_residual = self.sums[:, :, :n].sum(axis=0)
        self.gram[slot, :n] = self.gram[:n, slot] = by_newest + self.extras[:n] * self.extras[slot]
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(self.gram)[:n], math.ulp(0.0)))
        normal = self.gram[:n, :n] * scale[:, None] * scale[None, :]
        aim = (by_residual + self.extras[:n] * extra) * scale
        return np.asarray(np.linalg.lstsq(normal, aim, rcond=_SINGULAR)[0] * scale)
