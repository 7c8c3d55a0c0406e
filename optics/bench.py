"""The fixed set-up for which a lens is made: aperture, glass, light and screen."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

from optics.block import SCATTER_RAD, Back, scatter
from optics.light import Beam, Light, disc_points, meet
from optics.spectrum import Spectrum
from optics.spline import Array

Branch = Literal["direct", "inverted"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """A rectangle parallel to the stock's top, in work-frame x and y."""

    width_mm: float
    height_mm: float
    centre_x_mm: float
    centre_y_mm: float

    @property
    def left_mm(self) -> float:
        return self.centre_x_mm - self.width_mm / 2

    @property
    def bottom_mm(self) -> float:
        return self.centre_y_mm - self.height_mm / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """Lengths in mm. The aperture's lower left corner is the origin, the screen stands throw_mm above Z0.

    refractive_index : of the mean of the light's spectrum
    dispersion   : n_F - n_C of the glass; 0: all colours bend alike
    thickness_mm : from Z0 down to the flat face by which light enters; matters for diverging or tilted light
    mirror       : the surface reflects light from above, instead of refracting light that comes through the block
    outline_mm   : (k, 2) corners, counter-clockwise, of the lens within its aperture: dark outside. None: all of it
    haze, back   : of the block, `optics.block`; back None: flat
    branch       : "inverted": rays cross before the screen, which turns valleys into ridges but needs more relief
    """

    width_mm: float
    height_mm: float
    throw_mm: float
    refractive_index: float
    screen: Screen
    dispersion: float = 0.0
    thickness_mm: float = 40.0
    mirror: bool = False
    light: Light = field(default_factory=Light)
    outline_mm: Array | None = None
    haze: float = 0.0
    back: Back | None = None
    branch: Branch = "direct"

    @classmethod
    def centre_on(
        cls,
        *,
        width_mm: float,
        height_mm: float,
        throw_mm: float,
        refractive_index: float,
        screen_mm: tuple[float, float] | None = None,
        shift_mm: tuple[float, float] = (0.0, 0.0),
        **others: Any,
    ) -> Bench:
        """Return a screen of that size (None: the aperture's) whose centre is shift_mm from the aperture's."""
        wide, high = screen_mm or (width_mm, height_mm)
        screen = Screen(
            width_mm=wide,
            height_mm=high,
            centre_x_mm=width_mm / 2 + shift_mm[0],
            centre_y_mm=height_mm / 2 + shift_mm[1],
        )
        return cls(
            width_mm=width_mm,
            height_mm=height_mm,
            throw_mm=throw_mm,
            refractive_index=refractive_index,
            screen=screen,
            **others,
        )

    def beam(self, *, aside: tuple[float, float] = (0.0, 0.0), more_index: float = 0.0) -> Beam:
        """Return one beam of the light: the middle one, or the one at `aside`, in units of the source's radius, in a
        colour whose index is above the mean by more_index.
        """
        light = self.light
        centre_x, centre_y = self.width_mm / 2, self.height_mm / 2
        index, face = (1.0, 0.0) if self.mirror else (self.refractive_index + more_index, -self.thickness_mm)
        tan_x, tan_y = (math.tan(angle) for angle in light.tilt_rad)
        sign = -1.0 if self.mirror else 1.0
        radius = light.radius
        if light.is_point:
            x = centre_x - light.distance_mm * tan_x + radius * aside[0]
            y = centre_y - light.distance_mm * tan_y + radius * aside[1]
            z = face - sign * light.distance_mm
        else:
            tan_x, tan_y = tan_x + radius * aside[0], tan_y + radius * aside[1]
            in_air = math.sqrt(1.0 + tan_x**2 + tan_y**2)
            x, y = tan_x / in_air / index, tan_y / in_air / index  # the flat face keeps n times the sine
            z = sign * math.sqrt(1.0 - x * x - y * y)
        strength = np.ones((1, 1)) if light.profile is None else np.ascontiguousarray(light.profile, dtype=np.float64)
        beam = Beam(
            is_point=light.is_point,
            is_mirror=self.mirror,
            x=x,
            y=y,
            z=z,
            centre_x=centre_x,
            centre_y=centre_y,
            refractive_index=index,
            face=face,
            offset=0.0,
            strength=strength,
            cells_per_mm_x=(strength.shape[1] - 1) / self.width_mm,
            cells_per_mm_y=(strength.shape[0] - 1) / self.height_mm,
        )
        return beam._replace(offset=meet(beam, centre_x, centre_y, 0.0)[3])

    def bundle(self, beams: int) -> list[Beam]:
        """Return the light as beams of equal strength: at most that many.

        A source with a size has that many places, each with its own wavelength: places and colours are drawn evenly
        together, so that colours need no further beams. For a point source, colours lie on a line and not on a disc,
        and a quarter of that number is enough: `camera` 512, which has 45.9 dB in many, has 46.1 in 5 and 46.8 in 2.
        A single beam is the middle of all.
        """
        if not self.light.extended or beams <= 1:
            return [self.beam(more_index=more) for more in self.split_index(math.ceil(beams / 4))]
        places, colours = disc_points(beams), self.split_index(beams)
        mixed = _mix_colours(places, np.array(colours)) if len(colours) > 1 else np.zeros(beams)
        return [
            self.beam(aside=(float(x), float(y)), more_index=float(more))
            for (x, y), more in zip(places, mixed, strict=True)
        ]

    @property
    def flawless(self) -> Bench:
        """The bench with a clear and flat block, for which a lens is made."""
        return replace(self, haze=0.0, back=None)

    @property
    def clear(self) -> Bench:
        """The bench with a block without haze."""
        return replace(self, haze=0.0)

    def add_haze(self, irradiance: Array) -> Array:
        """Return irradiance (ny, nx) on the screen with this block's haze added."""
        if self.haze == 0.0:
            return irradiance
        (ny, nx), wide_mm = irradiance.shape, math.tan(SCATTER_RAD) * self.throw_mm
        sigma_px = (wide_mm * ny / self.screen.height_mm, wide_mm * nx / self.screen.width_mm)
        return scatter(irradiance, self.haze, sigma_px)

    def without_each_flaw(self) -> dict[str, Bench]:
        """Return, by the name of each flaw of its block, the bench without that flaw."""
        flaws = {"haze": self.clear, "back": replace(self, back=None)}
        return {name: bench for name, bench in flaws.items() if getattr(self, name)}

    def spare_colours(self) -> Bench:
        """Return the light in its mean colour if each colour costs a beam of its own; otherwise the light itself."""
        return self if self.light.extended else self.in_mean_colour()

    def in_mean_colour(self) -> Bench:
        """Return the light at one wavelength: that of the mean index of its colours."""
        return replace(self, light=replace(self.light, spectrum=Spectrum()))

    def split_index(self, parts: int) -> tuple[float, ...]:
        """Return the index less its mean for that many equal parts of the spectrum; one part if all bend alike."""
        if self.mirror or self.dispersion == 0.0:
            return (0.0,)
        return tuple(self.dispersion * share for share in self.light.spectrum.split(parts))

    @property
    def sign(self) -> float:
        """1 if the picture's left comes from the lens's left, -1 if rays cross on their way."""
        return -1.0 if self.branch == "inverted" else 1.0

    @property
    def shift_mm(self) -> tuple[float, float]:
        """From the middle of the aperture to the middle of the screen."""
        return self.screen.centre_x_mm - self.width_mm / 2, self.screen.centre_y_mm - self.height_mm / 2

    @property
    def even_upright_light(self) -> bool:
        """Whether the middle beam is even, along the axis, through a rectangular lens, and does not cross."""
        light = self.light
        special = self.mirror or light.is_point or light.profile is not None or light.tilt_rad != (0.0, 0.0)
        return not special and self.outline_mm is None and self.branch == "direct"

    def base_path_mm(self, qx_mm: Array | float, qy_mm: Array | float) -> Array:
        """Return the path, less its constant, that spreads the aperture roughly evenly over the screen, at its points
        (broadcast).

        The light is displaced by (kx x + ax, ky y + ay): x, y from the screen's centre, a the shift of the centres and
        k = 1 - aperture / screen, or 1 + aperture / screen on the inverted branch. The path's gradient is that over
        S = sqrt(|aside|^2 + H^2), for any light; for kx = ky that is the gradient of (kx x^2 + ky y^2 + 2 (ax x + ay
        y)) / (S + S of the centre).
        """
        s, (ax, ay) = self.screen, self.shift_mm
        kx, ky = 1 - self.sign * self.width_mm / s.width_mm, 1 - self.sign * self.height_mm / s.height_mm
        x, y = qx_mm - s.centre_x_mm, qy_mm - s.centre_y_mm
        ray = np.sqrt((kx * x + ax) ** 2 + (ky * y + ay) ** 2 + self.throw_mm**2)
        middle = math.sqrt(ax**2 + ay**2 + self.throw_mm**2)
        return np.asarray((kx * x**2 + ky * y**2 + 2 * (ax * x + ay * y)) / (ray + middle))

    def pixel_centres_mm(self, nx: int, ny: int) -> tuple[Array, Array]:
        """Return work-frame x (nx,) and y (ny,) of the screen's pixels."""
        s = self.screen
        return (
            s.left_mm + (np.arange(nx) + 0.5) * s.width_mm / nx,
            s.bottom_mm + (np.arange(ny) + 0.5) * s.height_mm / ny,
        )

    def kernel_arguments(self, nx: int, ny: int) -> tuple[float, ...]:
        """throw, index, screen left and bottom, pixel size, aperture size: the arguments of the kernels of
        optical_path.
        """
        s = self.screen
        return (
            self.throw_mm,
            self.refractive_index,
            s.left_mm,
            s.bottom_mm,
            s.width_mm / nx,
            s.height_mm / ny,
            self.width_mm,
            self.height_mm,
        )


def _mix_colours(places: Array, colours: Array) -> Array:
    """Return the colours in an order that favours neither a side nor the middle nor the rim of the disc.

    places (n, 2), colours (n,) ascending, mean 0. Pairs are swapped as long as that lowers the correlation.
    """
    x, y = places.T
    sides = np.stack([x, y, x * x + y * y, x * x - y * y, x * y])
    sides -= sides.mean(axis=1, keepdims=True)
    sides /= np.sqrt((sides**2).sum(axis=1, keepdims=True)) + 1e-300
    mixed, moved = colours.copy(), True
    while moved:
        moved = False
        for j, k in combinations(range(colours.size), 2):
            now = sides @ mixed
            then = now + (sides[:, j] - sides[:, k]) * (mixed[k] - mixed[j])
            if then @ then < (1.0 - 1e-9) * (now @ now):
                mixed[j], mixed[k], moved = mixed[k], mixed[j], True
    return mixed
