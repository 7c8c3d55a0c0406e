"""The shape of the test piece: strips of ripples, a ramp and a flat, the same on its left and on its right half.

Theory of operation. Ripples run along x, as the rows of the mill do: a row that lies too high or too low bends light
across the rows only, so that the fringes of a ripple stay clean even where the mill cuts its rows badly. A ripple a
cos(kx) makes fringes of the same period on the wall. Their strength is m = throw (n - 1) k^2 a; rays cross if m > 1. A
finish turns a into H(k) a. So one half is finished and the other left as milled: wall, lamp and camera affect both
halves alike, and only the finish makes a difference.

Amplitudes are just over odd multiples of half a step of the mill, about a level half a step under the flat, which is
on a step: so slopes run from the step below a crest to the step above a trough, and no row of the flat lies between two
steps. On a coarse mill, short ripples come out stronger than wanted, and their rays cross.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from optics.heightfield import Array, Heightfield

WIDTH_MM, HEIGHT_MM = 40.0, 20.0
HALF_MM = WIDTH_MM / 2
THROW_MM = 20.0
WINDOW_MM = 16.0
"""Of each half: the part along x in which fringes are measured; all ripples have whole numbers of periods in it."""

WINDOW_BEGINS_MM = 2.0  # from the left end of its half
_CYCLES = (4, 7, 11, 17, 23, 31, 39, 47)  # in the window: none is a multiple of another
_CONTRAST = 0.45  # m that is wanted
_OVER_STEP = 0.15  # half steps that a crest rises over its step: exactly on it, rounding would make steps
_LEAST_MM = 0.0005  # least amplitude that stands out from a mill's vibration
_RAMP_SLOPE, _RAMP_CYCLES, _RAMP_ROUNDING_MM = 0.02, 5, 0.08
_RIM_MM = 1.0
_STEEPEST = 0.04  # slope in y where a strip fades into the flat: light from there falls onto other strips
_ENDS_MM = 0.4  # length in which a ripple fades out beyond either side of the window
_SPOT_RADIUS_MM = 0.75
_SPOTS_MM = ((0.85, 1.2), (0.85, 18.8), (39.15, 1.2), (39.15, 18.8), (20.0, 18.8), (0.85, 14.0))
"""Small lenses that focus on the wall: corners, and two more that distinguish left from right and top from bottom."""

Kind = Literal["ripple", "ramp", "flat"]
Half = Literal["left", "right"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """Heights that depend on x alone, from low_mm to high_mm in y.

    cycles       : in the window; 0 for the flat
    amplitude_mm : of the ripple; of the ramp, half its rise
    """

    kind: Kind
    low_mm: float
    high_mm: float
    cycles: int = 0
    amplitude_mm: float = 0.0

    @property
    def period_mm(self) -> float:
        return WINDOW_MM / self.cycles if self.cycles else math.inf

    @property
    def k_rad_per_mm(self) -> float:
        return 2 * math.pi * self.cycles / WINDOW_MM

    @property
    def middle_mm(self) -> float:
        return (self.low_mm + self.high_mm) / 2

    @property
    def fade_mm(self) -> float:
        """Length in y, at either border, over which the strip fades into the flat."""
        return min(max(math.pi / 2 * self.amplitude_mm / _STEEPEST, 0.2), 0.8)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coupon:
    """The parameters of a piece, from which its strips follow.

    step_mm : of the mill's heights, 0 for none
    skim_mm : depth of its highest point under Z0
    """

    throw_mm: float = THROW_MM
    refractive_index: float = 1.49
    step_mm: float = 0.0
    skim_mm: float = 0.05

    @property
    def strips(self) -> tuple[Strip, ...]:
        """The strips from the lowest y up, with a flat rim around them."""
        ramp = _RAMP_SLOPE * WINDOW_MM / _RAMP_CYCLES / 4
        heights = (2.4, 3.0, 2.2, 1.6, 1.5, 1.4, 1.4, 1.4, 1.4, 1.7)
        rows: list[tuple[Kind, int, float]] = [("ramp", _RAMP_CYCLES, ramp)]
        rows += [("ripple", cycles, self._amplitude_mm(cycles)) for cycles in _CYCLES]
        rows.append(("flat", 0, 0.0))
        ends = _RIM_MM + np.cumsum((0.0, *heights))
        return tuple(
            Strip(kind=kind, low_mm=float(low), high_mm=float(high), cycles=cycles, amplitude_mm=amplitude)
            for (kind, cycles, amplitude), low, high in zip(rows, ends[:-1], ends[1:], strict=True)
        )

    @property
    def ripples(self) -> tuple[Strip, ...]:
        return tuple(strip for strip in self.strips if strip.kind == "ripple")

    @property
    def flat_mm(self) -> float:
        """Height of the flat, on a step; ripples swing around half a step below."""
        top = max(self.strips[0].amplitude_mm, self._spot_height_mm) + self.skim_mm
        return -top if self.step_mm == 0.0 else -math.ceil(top / self.step_mm) * self.step_mm

    def strength(self, strip: Strip) -> float:
        """Return m of a ripple as designed: the relative change of light; above 1 rays cross."""
        return self.throw_mm * (self.refractive_index - 1) * strip.k_rad_per_mm**2 * strip.amplitude_mm

    def heightfield(self, spacing_mm: float = 0.025) -> Heightfield:
        """Return the surface on a grid of about that spacing; 0.025 mm gives a dozen vertices in the shortest
        period.
        """
        nx, ny = round(WIDTH_MM / spacing_mm) + 1, round(HEIGHT_MM / spacing_mm) + 1
        x, y = np.linspace(0.0, WIDTH_MM, nx), np.linspace(0.0, HEIGHT_MM, ny)
        z = np.full((ny, nx), self.flat_mm)
        for strip in self.strips:
            if strip.cycles:
                z += share_of_strip(strip, y)[:, None] * self._profile_mm(strip, x)
        for x_mm, y_mm in _SPOTS_MM:
            z += self._spot_mm(np.hypot(x - x_mm, y[:, None] - y_mm))
        return Heightfield(x_mm=x, y_mm=y, z_mm=z)

    def _amplitude_mm(self, cycles: int) -> float:
        k = 2 * math.pi * cycles / WINDOW_MM
        wanted = max(_CONTRAST / (self.throw_mm * (self.refractive_index - 1) * k * k), _LEAST_MM)
        if self.step_mm == 0.0:
            return wanted
        return (2 * max(0, round(wanted / self.step_mm - 0.5)) + 1 + _OVER_STEP) * self.step_mm / 2

    def _profile_mm(self, strip: Strip, x_mm: Array) -> Array:
        """Return (nx,) heights over the flat, fading out beyond both windows."""
        along = np.mod(x_mm, HALF_MM) - WINDOW_BEGINS_MM
        beyond = np.maximum(-along, along - WINDOW_MM)
        part = np.clip(1.0 - beyond / _ENDS_MM, 0.0, 1.0)
        phase = strip.k_rad_per_mm * along
        if strip.kind == "ripple":
            wave = np.cos(phase)
        else:  # a roof with rounded ridges: its Fourier series, each term blurred
            n = np.arange(1, 40, 2)
            soft = np.exp(-((n * strip.k_rad_per_mm * _RAMP_ROUNDING_MM) ** 2) / 2)
            wave = 8 / math.pi**2 * (soft / n**2) @ np.cos(n[:, None] * phase)
        return np.asarray((strip.amplitude_mm * wave - self.step_mm / 2) * np.sin(part * math.pi / 2) ** 2)

    @property
    def _spot_height_mm(self) -> float:
        return _SPOT_RADIUS_MM**2 / (2 * self.throw_mm * (self.refractive_index - 1)) + 2e-3

    def _spot_mm(self, away_mm: Array) -> Array:
        """Return a cap that focuses on the wall, blended into the flat."""
        cap = self._spot_height_mm - away_mm**2 / (2 * self.throw_mm * (self.refractive_index - 1))
        soft = 3e-3  # a smooth maximum of the cap and 0
        return np.asarray(soft * np.logaddexp(0.0, np.minimum(cap / soft, 500.0)))


def share_of_strip(strip: Strip, y_mm: Array) -> Array:
    """Return (ny,) the share of a strip's heights at each y: 1 inside, fading to 0 at its borders."""
    inside = np.minimum(y_mm - strip.low_mm, strip.high_mm - y_mm)
    return np.asarray(np.sin(np.clip(inside / strip.fade_mm, 0.0, 1.0) * math.pi / 2) ** 2)


def window_mm(half: Half) -> tuple[float, float]:
    """Return the least and greatest x between which fringes are measured."""
    begins = WINDOW_BEGINS_MM + (HALF_MM if half == "right" else 0.0)
    return begins, begins + WINDOW_MM
