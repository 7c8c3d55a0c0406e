"""The light that falls on the lens: a person's description of it, and the beams that kernels follow.

A lens is lit through its flat face, a mirror from above. A *beam* comes from one direction or from one point; light
from a disc (the sun, a lamp of some size) or of several colours is a bundle of beams of equal strength. At a surface
point (x, y, z) the kernels need a beam's direction, its phase (index times the path so far, less a constant), and the
place where it crossed the *face*, the plane on which its strength is known. The amount of light is the same on the face
and on the surface, so no kernel needs to know how it spreads on the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from optics.spectrum import Spectrum
from optics.spline import Array

SUN_DEG = 0.53
_NEWTON_STEPS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """A light source on the optical axis (through the aperture's centre), or tilted against it.

    kind        : one of LIGHT_KINDS
    size_deg    : angular diameter of the sun
    distance_mm : of the point from the flat face of a lens, or from Z0 of a mirror
    size_mm     : diameter of the lamp, parallel to the face; 0 is a point
    profile     : (my, mx), at least 2 x 2, relative strength on the face, spread from rim to rim of the aperture, row 0
                  at the lowest y, bilinear between; None is even. Of a lamp it multiplies the law of distance.
    tilt_rad    : angles in x and y from the axis to the direction that light travels in (of a lamp: of its middle)
    spectrum    : its colours; the index of the bench's material is that of their mean
    middle_only : light from the middle of the source alone, as if it had no size
    """

    kind: str = "collimated"
    size_deg: float = SUN_DEG
    distance_mm: float = math.inf
    size_mm: float = 0.0
    profile: Array | None = None
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    spectrum: Spectrum = field(default_factory=Spectrum)
    middle_only: bool = False

    @property
    def is_point(self) -> bool:
        """Whether the light comes from distance_mm away, and not from infinity."""
        return LIGHT_KINDS[self.kind].is_point

    @property
    def radius(self) -> float:
        """Radius of its disc: in mm for a lamp, in radians for a disc of directions."""
        return 0.0 if self.middle_only else LIGHT_KINDS[self.kind].radius(self)

    @property
    def extended(self) -> bool:
        """Whether the light has more than one beam."""
        return self.radius > 0

    def width_rad(self, *, glass_mm: float) -> float:
        """Return the angular diameter behind the face, through the thickness of glass that is equivalent to glass_mm of
        air.
        """
        return 2 * self.radius / (self.distance_mm + glass_mm) if self.is_point else 2 * self.radius

    def spread_mm(self, throw_mm: float) -> float:
        """Return the diameter of a point's image on the wall, for a thin lens and this source."""
        if self.is_point:
            return throw_mm * (2 * self.radius) / self.distance_mm
        return throw_mm * 2 * math.tan(self.radius)


@dataclass(frozen=True, slots=True, kw_only=True)
class LightKind:
    """The optics of a kind of source: a point at a distance, a direction, or a disc of either.

    radius : of the disc [mm] or [rad], 0 where there is none
    """

    is_point: bool
    radius: Callable[[Light], float]


LIGHT_KINDS: dict[str, LightKind] = {
    "collimated": LightKind(is_point=False, radius=lambda light: 0.0),
    "sun": LightKind(is_point=False, radius=lambda light: math.radians(light.size_deg) / 2),
    "point": LightKind(is_point=True, radius=lambda light: light.size_mm / 2),
}


class Beam(NamedTuple):
    """One direction or one point, in the form of the kernels.

    x, y, z            : of a direction: the unit vector before the surface (inside the block); of a point: its place
    centre_x, centre_y : of the aperture, from where phases count
    refractive_index   : before the surface; 1 for a mirror
    face               : height of the face
    offset             : phase to be taken off, so that it is 0 at the aperture's centre at Z0
    strength (my, mx), cells_per_mm_x, .._y : the profile over the aperture; 1 x 1 stands for an even one
    """

    is_point: bool
    is_mirror: bool
    x: float
    y: float
    z: float
    centre_x: float
    centre_y: float
    refractive_index: float
    face: float
    offset: float
    strength: Array
    cells_per_mm_x: float
    cells_per_mm_y: float


@njit(cache=True, nogil=True, error_model="numpy")
def _tangent_before_face(run: float, away: float, depth: float, index: float) -> float:
    """Return tangent of the angle outside, of the ray that goes `run` sideways over `away` in air and `depth` in glass.

    run = away w + depth w / sqrt(n^2 + (n^2 - 1) w^2): concave in w, so that Newton's method climbs to the root.
    """
    near = away + depth / index
    w = run / near
    w *= 1.0 + min(depth * (index * index - 1.0) * w * w / (2.0 * index * index * index * near), 0.5)  # up to w^5
    for _ in range(_NEWTON_STEPS):
        root = math.sqrt(index * index + (index * index - 1.0) * w * w)
        miss = run - away * w - depth * w / root
        step = miss / (away + depth * index * index / (root * root * root))
        w += step
        if abs(step) <= 1e-8 * (1.0 + w):  # the next step would be its square
            break
    return w


@njit(cache=True, nogil=True, error_model="numpy")
def meet(beam: Beam, x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Return (dx, dy, dz, phase, face_x, face_y) of the beam where it meets (x, y, z); the direction is a unit
    vector.
    """
    if not beam.is_point:
        way = (z - beam.face) / beam.z
        phase = beam.refractive_index * (beam.x * (x - beam.centre_x) + beam.y * (y - beam.centre_y) + beam.z * z)
        return beam.x, beam.y, beam.z, phase - beam.offset, x - way * beam.x, y - way * beam.y
    rx, ry = x - beam.x, y - beam.y
    if beam.is_mirror:
        rz = z - beam.z
        far = math.sqrt(rx * rx + ry * ry + rz * rz)
        share = (beam.face - beam.z) / rz
        return rx / far, ry / far, rz / far, far - beam.offset, beam.x + share * rx, beam.y + share * ry
    run = math.sqrt(rx * rx + ry * ry)
    away, depth = beam.face - beam.z, z - beam.face
    w = _tangent_before_face(run, away, depth, beam.refractive_index)
    outside = away * w
    ex, ey = (rx / run, ry / run) if run > 0.0 else (0.0, 0.0)
    wide = math.sqrt(1.0 + w * w)
    sine = w / wide / beam.refractive_index
    cosine = math.sqrt(1.0 - sine * sine)
    phase = away * wide + beam.refractive_index * depth / cosine  # stays valid under the face, where iterates may go
    return (
        ex * sine, ey * sine, cosine, phase - beam.offset,
        beam.x + ex * outside, beam.y + ey * outside,
    )  # fmt: skip


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def strength_on_face(beam: Beam, x: float, y: float) -> float:
    """Return light per area of the face at (x, y); its scale is free. Beyond the aperture the profile's rim goes on.

    NaN where x or y is not finite: such a place is in no cell of the profile.
    """
    if not math.isfinite(x + y):
        return math.nan
    value = 1.0
    if beam.is_point:
        away = beam.face - beam.z
        r2 = (x - beam.x) ** 2 + (y - beam.y) ** 2
        value = (1.0 + r2 / (away * away)) ** -1.5
    my, mx = beam.strength.shape
    if mx < 2 or my < 2:
        return value
    u = min(max(x * beam.cells_per_mm_x, 0.0), mx - 1.0)
    v = min(max(y * beam.cells_per_mm_y, 0.0), my - 1.0)
    i, j = min(int(u), mx - 2), min(int(v), my - 2)
    f, g = u - i, v - j
    low = (1.0 - f) * beam.strength[j, i] + f * beam.strength[j, i + 1]
    high = (1.0 - f) * beam.strength[j + 1, i] + f * beam.strength[j + 1, i + 1]
    return value * ((1.0 - g) * low + g * high)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def leave(
    dx: float, dy: float, dz: float, zx: float, zy: float, index: float, is_mirror: bool
) -> tuple[float, float, float]:
    """Return the unit direction behind a surface of slope (zx, zy) met along (dx, dy, dz); NaN: light does not get out.

    With N the upward unit normal and cos = d . N: refracted n d + (sqrt(1 - n^2 (1 - cos^2)) - n cos) N, mirrored
    d - 2 cos N. Light that would leave downward counts as not getting out.
    """
    nz = 1.0 / math.sqrt(1.0 + zx * zx + zy * zy)
    nx, ny = -zx * nz, -zy * nz
    cos = dx * nx + dy * ny + dz * nz
    if is_mirror:
        push, keep = -2.0 * cos, 1.0
        if cos >= 0.0:
            return math.nan, math.nan, math.nan
    else:
        inner = 1.0 - index * index * (1.0 - cos * cos)
        if inner <= 0.0 or cos <= 0.0:
            return math.nan, math.nan, math.nan
        push, keep = math.sqrt(inner) - index * cos, index
    tz = keep * dz + push * nz
    if tz <= 0.0:
        return math.nan, math.nan, math.nan
    return keep * dx + push * nx, keep * dy + push * ny, tz


def disc_points(count: int) -> Array:
    """Return (count, 2) points spread evenly over a disc of radius 1, like a sunflower's seeds; one point is the
    middle.
    """
    if count == 1:
        return np.zeros((1, 2))
    k = np.arange(count) + 0.5
    radius, angle = np.sqrt(k / count), k * math.pi * (3.0 - math.sqrt(5.0))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.asarray(points - points.mean(axis=0))
