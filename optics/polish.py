"""Polish: minimises the mean error of the pictures that the lens may give, over the heights of its vertices.

The error and its exact gradient are those of `outcomes`, the method is L-BFGS. First inverse Hessian: a dent of
Laplacian L changes the light by I (n - 1) H L, so it is A^-1 / (I^2 + delta) A^-T with A
the square root of ((n - 1) H)^2 (L^2 + beta L) (m + eps) / v^2 in cosines. m is how far a pixel averages a wave out,
v the vertices along its side; beta holds long waves back, which move edges instead of making light. (Measured on
camera 256: |J dz|^2 is 1.4 to 1.1 times I (n - 1) H L / v at 4 to 128 of 512 half waves, 0.8 at 128-192, 0.05 at
384-512.) Behind a finish a wave has to be 1 / H times as high, up to the wave number where that is not worth it.
Four tubes along a pixel's side overfit their own lattice, so the last steps see six. They also see two colours of white
light, while all others see its mean: `camera` 512 then has 46.5 dB in white, 43.7 with one colour in all steps, 48.0
with colours in all, which takes half as long again. Behind a finish the surface is smooth, and two tubes are enough; on
a large lens one, on every second vertex. But all pixels count: half of them do not show the fine bright lines of too
little work (`camera` 512, k0 x 1.25: 22.8 dB in place of 23.8). If a ball has to fit, its fit is restored at the end:
the descent hardly bends the surface, and the correction costs 0.1 dB.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter

from optics.ball_fit import fit_ball
from optics.bench import Bench
from optics.contact import weigh_nodes
from optics.finish import Finish, level
from optics.heightfield import Heightfield
from optics.outcomes import MeanError, Outcome, outcomes_of
from optics.spline import Array, BicubicSpline, Mask

_DEPTH = 8
_LONG_WAVES = 1500.0  # beta, times the aperture's area
_UNSEEN = 0.015  # eps
_LEAST_LIGHT = 0.2  # delta of a picture without black; 0.8 more where half of it is
_FIRST_LENGTH = 0.1  # the inverse Hessian is too large until the first pair of step and gradient scales it
_SUFFICIENT = 1e-4  # of the decrease that the slope promises (Armijo)
_MOST_TRIES = 6
_FINE_SHARE = 0.2  # of the steps; 0.3 gains 0.1 dB in white for a tenth of the time
_TUBES_PER_PIXEL, _FINE_TUBES_PER_PIXEL = 4, 6  # along its side
_FINISHED_TUBES_PER_PIXEL = 2  # of a smooth surface: four show the same within 0.1 dB
_LOST = 0.01  # H^2 of a wave that is not worth its height; 0.003 shows up to 0.1 dB more, but films need more steps
_SEEN_VERTICES = 4.0  # width of the average behind a finish: finer waves are then used as far as they help (+ 0.2 dB)
_HALVED_FROM = 512  # pixels along the shorter side
_ROUND = 16  # steps from one touch to the next: 8 have less error and show less, SSIM 0.795 in place of 0.837
_SHARES = (1.0, 0.5, 0.25)  # tried shares of a round's step
_RIM = 2.0  # times the reach of a finish: within it heights move less toward the rim, and not at all at the rim
_BESIDE = 0.8  # times 1 / k0: where a pad bridges, and within this distance, heights are not changed


class Memory:
    """The last pairs of step and change of gradient, and the direction that they and an initial inverse Hessian give.

    L-BFGS's two-loop recursion (Nocedal and Wright, algorithm 7.4).
    """

    def __init__(self, depth: int) -> None:
        self.pairs: deque[tuple[Array, Array, float]] = deque(maxlen=depth)

    def learn(self, step: Array, change: Array) -> None:
        """Store a pair; skip one without positive curvature along the step."""
        curvature = float((step * change).sum())
        if curvature > 0.0:
            self.pairs.append((step, change, curvature))

    def direction(self, gradient: Array, inverse: Callable[[Array], Array]) -> Array:
        """Return minus the inverse Hessian times the gradient.

        `inverse` approximates it where nothing is known yet, up to a factor, which the last pair determines.
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
    """A record of the descent.

    steps          : accepted ones
    psnr_db_*      : before and after, under the light that the lens was designed for, finished as planned; with few of
                     several colours, and behind a finish with the mean one (`MeanError`)
    change_um_rms  : how far the vertices moved, root mean square, a common lift left out
    seconds        : wall time
    """

    steps: int
    psnr_db_before: float
    psnr_db_after: float
    change_um_rms: float
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Polished:
    """Heights (ny, nx) of a lens after its descent; task: `digest_task` of what it was made from."""

    z_mm: Array
    record: PolishRecord
    task: bytes


@dataclass(slots=True)
class _Point:
    """Heights, the mean error of their pictures and its gradient."""

    z: Array
    error: float
    gradient: Array


class _Preconditioner:
    """The first inverse Hessian: P g = A^-1 / (I^2 + delta) A^-T g, with I at the heights of the last evaluation.

    free : 0 where heights are left alone, 1 elsewhere; (ny, nx), or one for all
    """

    def __init__(self, lens: Heightfield, target: Array, bench: Bench, error: MeanError, free: Array | float) -> None:
        self.free = free
        ny, nx = lens.z_mm.shape
        per_pixel_x, per_pixel_y = (nx - 1) / target.shape[1], (ny - 1) / target.shape[0]
        wx, wy = (np.pi * np.arange(n) / (n - 1) for n in (nx, ny))
        across, along = bench.width_mm / bench.screen.width_mm, bench.height_mm / bench.screen.height_mm
        laplacian = ((2 - 2 * np.cos(wx)) * across / lens.dx_mm**2)[None, :] + (
            (2 - 2 * np.cos(wy)) * along / lens.dy_mm**2
        )[:, None]
        finish = error.outcomes[0].finish
        averaged = (per_pixel_x, per_pixel_y) if finish is None else (_SEEN_VERTICES, _SEEN_VERTICES)
        seen = _box_power(wx, averaged[0])[None, :] * _box_power(wy, averaged[1])[:, None]
        beta = _LONG_WAVES / (bench.width_mm * bench.height_mm)
        power = 2.0 if bench.mirror else bench.refractive_index - 1
        square = (power * bench.throw_mm) ** 2 * (laplacian**2 + beta * laplacian) * (seen + _UNSEEN)
        square[0, 0] = np.inf  # a common lift
        if finish is not None:
            square *= finish.multipliers((ny, nx), (lens.dy_mm, lens.dx_mm)) ** 2 + _LOST
        self.symbol = np.sqrt(per_pixel_x * per_pixel_y / square)
        self.nodes = weigh_nodes((ny, nx))
        dark = float((target < 0.1).mean())
        irradiance = error.tubes[0].sample_at_vertices(error.misses[0] + target)
        self.weight = 1.0 / (irradiance**2 + _LEAST_LIGHT + 0.8 * min(1.0, 2 * dark))

    def __call__(self, gradient: Array) -> Array:
        inner = self.weight * self.nodes * level(self.free * gradient / self.nodes, self.symbol)
        return self.free * level(inner, self.symbol)


def _rise(at_mm: Array, over_mm: float) -> Array:
    """Return (n,) 0 at either end and 1 from over_mm on, level there and at the ends."""
    share = np.minimum(at_mm - at_mm[0], at_mm[-1] - at_mm) / over_mm
    return np.asarray(np.sin(np.pi / 2 * np.minimum(share, 1.0)) ** 2)


def _box_power(w: Array, width: float) -> Array:
    """Return the fourth power of the transfer function of averaging over `width` vertices, for a wave of w radians a
    vertex.
    """
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
    finish: Finish | None = None,
    as_planned: bool = False,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[Heightfield, PolishRecord]:
    """Return the lens, its top unchanged, after at most `steps` steps of descent, and a record of them.

    target     : (ny, nx), work frame, mean 1
    ball_mm    : radius of the ball that must still fit afterwards; 0 if none has to
    finish     : after milling: the pictures are those behind it
    as_planned : optimise only for the planned finish, not for its other outcomes: a quick look

    The lens is returned unchanged if finer tubes show no gain, or no gain as planned.
    """
    started = time.perf_counter()
    taken = 0

    def report(share: float) -> None:
        if on_progress is not None:
            on_progress(share)

    def count_step() -> None:
        nonlocal taken
        taken += 1
        report(taken / steps)

    outcomes = outcomes_of(finish)
    per_pixel = _FINE_TUBES_PER_PIXEL if finish is None else _FINISHED_TUBES_PER_PIXEL
    last = _error_of(lens, target, bench, outcomes[:1], per_pixel)
    last.touch(lens.z_mm)
    before, before_db = last.of(lens.z_mm), last.psnr_db()
    z = np.array(lens.z_mm)
    if finish is None:
        few = math.ceil(_FINE_SHARE * steps)
        error = _error_of(lens, target, bench.spare_colours(), outcomes, _TUBES_PER_PIXEL)
        z = _descend(error, lens, z, bench, steps - few, count_step)
        z = _descend(last, lens, z, bench, few, count_step)
    else:
        likely = outcomes[: 1 if as_planned else None]
        halved = _can_be_halved(lens, target)
        coarse = _halve_lens(lens) if halved else lens
        error = _error_of(coarse, target, bench, likely, 1 if halved else per_pixel)
        moved = _descend(error, coarse, np.array(coarse.z_mm), bench, steps, count_step) - coarse.z_mm
        z += _spline_of(coarse, moved).heights_mm(lens.x_mm[None, :], lens.y_mm[:, None]) if halved else moved
    report(1.0)
    done = _fit_ball(lens, z, ball_mm)
    last.touch(done.z_mm)
    after, after_db = last.of(done.z_mm), last.psnr_db()
    better = taken > 0 and after < before
    if not better:
        done, after_db = lens, before_db
    return done, PolishRecord(
        steps=taken if better else 0,
        psnr_db_before=before_db,
        psnr_db_after=after_db,
        change_um_rms=1e3 * float(np.std(done.z_mm - lens.z_mm)),
        seconds=time.perf_counter() - started,
    )


def digest_task(
    lens: Heightfield, target: Array, bench: Bench, *, steps: int, ball_mm: float, finish: Finish | None
) -> bytes:
    """Return a digest of all that the result of `polish_lens` depends on."""
    arrays = [lens.x_mm, lens.y_mm, lens.z_mm, target]
    if bench.outline_mm is not None:
        arrays.append(bench.outline_mm)
    numbers = (lens.rim_mm, replace(bench, outline_mm=None), steps, ball_mm, finish, [array.shape for array in arrays])
    digest = hashlib.sha256(repr(numbers).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def _error_of(lens: Heightfield, target: Array, bench: Bench, outcomes: list[Outcome], per_pixel: int) -> MeanError:
    tubes = max(1, math.ceil(per_pixel * target.shape[1] / (lens.x_mm.size - 1)))
    return MeanError(lens, target, bench, outcomes, tubes)


def _can_be_halved(lens: Heightfield, target: Array) -> bool:
    """Return whether every second vertex is enough, and makes a lens of the same size in mm."""
    return min(target.shape) >= _HALVED_FROM and all(n % 2 for n in lens.z_mm.shape)


def _halve_lens(lens: Heightfield) -> Heightfield:
    return replace(lens, x_mm=lens.x_mm[::2], y_mm=lens.y_mm[::2], z_mm=lens.z_mm[::2, ::2])


def _fit_ball(lens: Heightfield, z: Array, ball_mm: float) -> Heightfield:
    """Return the lens with heights z, its top unchanged, in whose hollows the ball fits."""
    moved = replace(lens, z_mm=z - (z.max() - lens.z_mm.max()))
    return fit_ball(moved, ball_mm) if ball_mm > 0 else moved


def _spline_of(lens: Heightfield, z: Array) -> BicubicSpline:
    return BicubicSpline.through(
        z, x0_mm=float(lens.x_mm[0]), y0_mm=float(lens.y_mm[0]), dx_mm=lens.dx_mm, dy_mm=lens.dy_mm
    )


def _descend(
    error: MeanError, lens: Heightfield, z: Array, bench: Bench, steps: int, on_step: Callable[[], None]
) -> Array:
    """Return heights after at most that many steps; stop early if no step lowers the error.

    With a finish it works in rounds. After each round the contact is computed again, and only the part of the step that
    is a gain is taken.
    """
    finish = error.outcomes[0].finish
    hangs = error.touch(z)
    point = _Point(z, error.of(z), error.gradient())
    if finish is None:
        return _take_steps(error, point, _Preconditioner(lens, error.target, bench, error, 1.0), steps, on_step).z
    beside = _BESIDE / finish.k0_rad_per_mm / min(lens.dx_mm, lens.dy_mm)
    inside = np.outer(*(_rise(axis, _RIM * finish.reach_mm) for axis in (lens.y_mm, lens.x_mm)))
    for begun in range(0, steps, _ROUND):
        inverse = _Preconditioner(lens, error.target, bench, error, inside * _mark_free(hangs, beside))
        way = _take_steps(error, point, inverse, min(steps - begun, _ROUND), on_step).z - point.z
        for share in _SHARES:
            z = point.z + share * way
            hangs = error.touch(z)
            if (value := error.of(z)) < point.error:
                point = _Point(z, value, error.gradient())
                break
        else:
            break
    return point.z


def _take_steps(
    error: MeanError, point: _Point, inverse: _Preconditioner, steps: int, on_step: Callable[[], None]
) -> _Point:
    """Return the point after at most that many steps, with fixed contact."""
    memory = Memory(_DEPTH)
    for _ in range(steps):
        moved = _step(error, point, memory, inverse)
        if moved is None:
            break
        point = moved
        on_step()
    return point


def _mark_free(hangs: Mask, beside: float) -> Array:
    """Return 1 where heights may move, 0 where a pad bridges and within `beside` vertices of there."""
    if not hangs.any():
        return np.ones(hangs.shape)
    near = binary_dilation(hangs, iterations=max(1, round(beside)))
    return np.asarray(1.0 - gaussian_filter(near.astype(np.float64), beside / 2.0))


def _step(error: MeanError, point: _Point, memory: Memory, inverse: _Preconditioner) -> _Point | None:
    """Return the next point, with sufficient decrease; None if no step length along the direction gives it."""
    length = 1.0 if memory.pairs else _FIRST_LENGTH
    direction = memory.direction(point.gradient, inverse)
    slope = float((point.gradient * direction).sum())
    for _ in range(_MOST_TRIES):
        z = point.z + length * direction
        value = error.of(z)
        if value <= point.error + _SUFFICIENT * length * slope:
            moved = _Point(z, value, error.gradient())
            memory.learn(length * direction, moved.gradient - point.gradient)
            return moved
        bend = value - point.error - length * slope  # the minimum of the parabola through the known values
        length *= min(0.5, max(0.1, -slope * length / (2 * bend))) if math.isfinite(bend) else 0.1
    return None
