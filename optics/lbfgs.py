"""Limited-memory BFGS with a preconditioner: the two-loop recursion (Nocedal and Wright, algorithm 7.4)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from optics.spline import Array


class Memory:
    """The last pairs of step and change of gradient, and the direction that they and a first inverse Hessian give."""

    def __init__(self, depth: int) -> None:
        self.pairs: deque[tuple[Array, Array, float]] = deque(maxlen=depth)

    def learn(self, step: Array, change: Array) -> None:
        """Take in a pair; one without positive curvature along the step is passed over."""
        curvature = float((step * change).sum())
        if curvature > 0.0:
            self.pairs.append((step, change, curvature))

    def direction(self, gradient: Array, inverse: Callable[[Array], Array]) -> Array:
        """Return minus the inverse Hessian times the gradient.

        `inverse` stands for it where nothing is known yet, but for a factor, which the last pair tells.
        """
        q = gradient.copy()
        shares = []
        for step, change, curvature in reversed(self.pairs):
            share = float((step * q).sum()) / curvature
            q -= share * change
            shares.append(share)
        d = inverse(q)
        if self.pairs:
            _, change, curvature = self.pairs[-1]
            d *= curvature / float((change * inverse(change)).sum())
        for (step, change, curvature), share in zip(self.pairs, reversed(shares), strict=True):
            d += (share - float((change * d).sum()) / curvature) * step
        return -d
