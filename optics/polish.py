"""Polish: a descent on the picture's own error over the heights of the lens's vertices.

E = 1/2 sum over pixels of (I - T)^2 with I by flux tubes on the C2 spline, its exact gradient, and L-BFGS. First
inverse Hessian: a dent of Laplacian L changes the light by I (n - 1) H L, so it is A^-1 / (I^2 + delta) A^-T with A
the square root of ((n - 1) H)^2 (L^2 + beta L) (m + eps) / v^2 in cosines. m is how far a pixel averages a wave out,
v the vertices along its side; beta holds long waves back, which move edges instead of making light. (Measured on
camera 256: |J dz|^2 is 1.4 to 1.1 times I (n - 1) H L / v at 4 to 128 of 512 half waves, 0.8 at 128-192, 0.05 at
384-512.)
Four tubes along a pixel's side overfit their own lattice, so the last steps see six. A ball that has to fit is looked
after at the end: the descent hardly bends the surface, and what it does bend too far costs 0.1 dB to take back.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from optics.ball_fit import fit_ball
from optics.bench import Bench
from optics.heightfield import Heightfield
from optics.spline import Array
from optics.threads import thread_count
from optics.tubes.picture import TubePicture

_DEPTH = 8
_LONG_WAVES = 1500.0  # beta, times the aperture's area
_UNSEEN = 0.015  # eps
_LEAST_LIGHT = 0.2  # delta of a picture without black; 0.8 more where half of it is
_FIRST_LENGTH = 0.1  # the inverse Hessian is too bold until the first pair of step and gradient scales it
_SUFFICIENT = 1e-4  # of the decrease that the slope promises (Armijo)
_MOST_TRIES = 6
_FINE_SHARE = 0.3  # of the steps
_TUBES_PER_PIXEL, _FINE_TUBES_PER_PIXEL = 4, 6  # along its side
DESIGN_BEAMS = 7  # of an extended light, while a lens is designed for it


class Memory:
    """The last pairs of step and change of gradient, and the direction that they and a first inverse Hessian give.

    L-BFGS's two-loop recursion (Nocedal and Wright, algorithm 7.4).
    """

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


@dataclass(frozen=True, slots=True, kw_only=True)
class PolishRecord:
    """What the descent did.

    steps          : accepted ones
    psnr_db_*      : before and after, under the light that the lens was designed for
    change_um_rms  : how far the vertices moved, root mean square, a common lift left out
    seconds        : wall time
    """

    steps: int
    psnr_db_before: float
    psnr_db_after: float
    change_um_rms: float
    seconds: float


@dataclass(slots=True)
class _Point:
    """Heights, the error of their picture and its gradient."""

    z: Array
    error: float
    gradient: Array


class _Error:
    """E of heights, by that many tubes a cell side."""

    def __init__(self, lens: Heightfield, target: Array, bench: Bench, tubes_per_cell: int) -> None:
        self.target = target
        self.tubes = TubePicture(lens, bench, pixels=target.shape, tubes_per_cell=tubes_per_cell, beams=DESIGN_BEAMS)
        self.miss = target

    def of(self, z: Array) -> float:
        self.miss = self.tubes.picture(z) - self.target
        return 0.5 * float((self.miss**2).sum())

    def at(self, z: Array) -> _Point:
        return _Point(z, self.of(z), self.tubes.gain(self.miss))


class _Preconditioner:
    """The first inverse Hessian: P g = A^-1 / (I^2 + delta) A^-T g."""

    def __init__(self, lens: Heightfield, target: Array, bench: Bench, error: _Error) -> None:
        ny, nx = lens.z_mm.shape
        per_pixel_x, per_pixel_y = (nx - 1) / target.shape[1], (ny - 1) / target.shape[0]
        wx, wy = (np.pi * np.arange(n) / (n - 1) for n in (nx, ny))
        across, along = bench.width_mm / bench.screen.width_mm, bench.height_mm / bench.screen.height_mm
        laplacian = ((2 - 2 * np.cos(wx)) * across / lens.dx_mm**2)[None, :] + (
            (2 - 2 * np.cos(wy)) * along / lens.dy_mm**2
        )[:, None]
        seen = _box_power(wx, per_pixel_x)[None, :] * _box_power(wy, per_pixel_y)[:, None]
        beta = _LONG_WAVES / (bench.width_mm * bench.height_mm)
        power = 2.0 if bench.mirror else bench.refractive_index - 1
        square = (power * bench.throw_mm) ** 2 * (laplacian**2 + beta * laplacian) * (seen + _UNSEEN)
        square[0, 0] = np.inf  # a common lift
        self.symbol = np.sqrt(per_pixel_x * per_pixel_y / square)
        self.rim = np.ones((ny, nx))  # cosines are orthogonal with rim vertices counted half
        for edge in (self.rim[0], self.rim[-1], self.rim[:, 0], self.rim[:, -1]):
            edge *= 0.5
        dark = float((target < 0.1).mean())
        irradiance = error.tubes.seen_from_vertices(error.miss + target)
        self.weight = 1.0 / (irradiance**2 + _LEAST_LIGHT + 0.8 * min(1.0, 2 * dark))

    def __call__(self, gradient: Array) -> Array:
        return self._root(self.weight * self.rim * self._root(gradient / self.rim))

    def _root(self, values: Array) -> Array:
        spectrum = fft.dctn(values, type=1, workers=thread_count())
        spectrum *= self.symbol
        return np.asarray(fft.idctn(spectrum, type=1, workers=thread_count(), overwrite_x=True))


def _box_power(w: Array, width: float) -> Array:
    """Return the fourth power of what averaging over `width` vertices leaves of a wave of w radians a vertex."""
    with np.errstate(invalid="ignore", divide="ignore"):
        left = np.sin(width * w / 2) / (width * np.sin(w / 2))
    return np.asarray(np.where(w == 0, 1.0, left) ** 4)


def polish_lens(
    lens: Heightfield,
    target: Array,
    bench: Bench,
    *,
    steps: int,
    ball_mm: float = 0.0,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[Heightfield, PolishRecord]:
    """Return the lens (its top where it was) after at most that many steps of descent, and a record of them.

    target  : (ny, nx), work frame, mean 1
    ball_mm : radius of the ball that must fit afterwards as well; 0 where none has to

    The lens comes back as it was where its finer tubes see no gain.
    """
    started = time.perf_counter()
    report = on_progress or (lambda share: None)
    per_pixel = (lens.x_mm.size - 1) / target.shape[1]
    coarse, fine = (
        _Error(lens, target, bench, max(1, math.ceil(tubes / per_pixel)))
        for tubes in (_TUBES_PER_PIXEL, _FINE_TUBES_PER_PIXEL)
    )
    before = fine.of(lens.z_mm)
    point = coarse.at(np.array(lens.z_mm))
    inverse = _Preconditioner(lens, target, bench, coarse)
    memory, taken, fine_steps = Memory(_DEPTH), 0, math.ceil(_FINE_SHARE * steps)
    for error, count in ((coarse, steps - fine_steps), (fine, fine_steps)):
        if error is fine:
            point = fine.at(point.z)
        for _ in range(count):
            moved = _step(error, point, memory, inverse)
            if moved is None:
                break
            point, taken = moved, taken + 1
            report(taken / steps)
    report(1.0)
    done = _fit_ball(lens, point.z, ball_mm)
    after = fine.of(done.z_mm)
    better = taken > 0 and after < before
    if not better:
        done, after = lens, before
    return done, PolishRecord(
        steps=taken if better else 0,
        psnr_db_before=_psnr_db(before, target),
        psnr_db_after=_psnr_db(after, target),
        change_um_rms=1e3 * float(np.std(done.z_mm - lens.z_mm)),
        seconds=time.perf_counter() - started,
    )


def _fit_ball(lens: Heightfield, z: Array, ball_mm: float) -> Heightfield:
    """Return the lens with heights z, its top where it was, in whose hollows the ball fits."""
    moved = replace(lens, z_mm=z - (z.max() - lens.z_mm.max()))
    return fit_ball(moved, ball_mm) if ball_mm > 0 else moved


def _step(error: _Error, point: _Point, memory: Memory, inverse: _Preconditioner) -> _Point | None:
    """Return the next point, with enough of a decrease; None where no length along the direction gives it."""
    length = 1.0 if memory.pairs else _FIRST_LENGTH
    direction = memory.direction(point.gradient, inverse)
    slope = float((point.gradient * direction).sum())
    for _ in range(_MOST_TRIES):
        z = point.z + length * direction
        value = error.of(z)
        if value <= point.error + _SUFFICIENT * length * slope:
            moved = _Point(z, value, error.tubes.gain(error.miss))
            memory.learn(length * direction, moved.gradient - point.gradient)
            return moved
        bend = value - point.error - length * slope  # of the parabola through what is known
        length *= min(0.5, max(0.1, -slope * length / (2 * bend))) if math.isfinite(bend) else 0.1
    return None


def _psnr_db(error: float, target: Array) -> float:
    return float(10 * np.log10(target.max() ** 2 * target.size / max(2 * error, 1e-300)))
