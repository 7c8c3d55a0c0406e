"""A polishing bob: Hertz's contact, Preston's law, the low pass that it makes, and the dwell that takes off evenly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optics.bob import Bob
from optics.bob_wear import Contacts, Ground
from optics.heightfield import Heightfield
from optics.outcomes import outcomes_of
from tests.optics.bobs import make_finish

BOB = Bob(radius_mm=3.0, modulus_mpa=1.0, wear_per_mpa=8e-5, compression_mm=0.3, spindle_rpm=10_000.0)


def plane(slope: float, side_mm: float = 12.0) -> Heightfield:
    x = np.linspace(0.0, side_mm, 25)
    return Heightfield(x_mm=x, y_mm=x, z_mm=np.tile(slope * (x - side_mm) - 0.1, (25, 1)))


def stand_on_plane(slope: float, x_mm: float, y_mm: float, side_mm: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    """Return contact (2,) and tip (3,) of the bob pressed in along the normal there."""
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(1.0, slope)
    point = np.array([x_mm, y_mm, slope * (x_mm - side_mm) - 0.1])
    centre = point + (BOB.radius_mm - BOB.compression_mm) * normal
    return point[:2], centre - [0.0, 0.0, BOB.radius_mm]


@given(slope=st.floats(0.0, 1.0))
def test_a_planes_removal_is_prestons(slope: float) -> None:
    """The volume is c F v for the mean sliding speed, which a quadrature of Hertz's pressure gives."""
    at, tip = stand_on_plane(slope, 6.0, 6.0)
    ground = Ground.under(BOB, plane(slope), beyond_mm=2.0)
    off = ground.wear(BOB, Contacts(at_mm=at[None], tip_mm=tip[None], dwell_s=np.array([2.0])))
    volume = off.sum() * ground.cell_mm**2
    assert volume == pytest.approx(2.0 * BOB.rate_mm3_per_s(slope), rel=0.07)
    force = 4 / 3 * BOB.modulus_mpa * np.sqrt(BOB.radius_mm) * BOB.compression_mm**1.5
    assert BOB.force_n == pytest.approx(force)
    sine = slope / np.hypot(1.0, slope)
    r, turn = np.sqrt(np.linspace(0, 1, 400, endpoint=False) + 1 / 800), np.linspace(0, 2 * np.pi, 64, endpoint=False)
    along = BOB.contact_mm * r[:, None] * np.cos(turn) * np.sqrt(1 - sine**2)
    across = BOB.contact_mm * r[:, None] * np.sin(turn)
    sliding = np.hypot((BOB.radius_mm - BOB.compression_mm) * sine + along, across)
    weight = np.sqrt(1 - r**2)[:, None] * np.ones(turn.size)
    mean = np.average(sliding, weights=weight) * BOB.turn_rad_per_s
    assert BOB.rate_mm3_per_s(slope) == pytest.approx(BOB.wear_per_mpa * force * mean, rel=0.07)


@given(modulus=st.floats(0.05, 50.0), depth_um=st.floats(1.0, 200.0))
def test_the_low_pass_does_not_depend_on_hardness(modulus: float, depth_um: float) -> None:
    soft, hard = (make_finish(replace(BOB, modulus_mpa=one), depth_um / 1000) for one in (1.0, modulus))
    assert hard.k0_rad_per_mm == pytest.approx(soft.k0_rad_per_mm)
    assert soft.after(2.0).k0_rad_per_mm == pytest.approx(make_finish(replace(BOB), depth_um / 500).k0_rad_per_mm)


def test_a_bob_turns_out_more_evenly_than_a_hand() -> None:
    """No outcome of another order, and none with more than a fifth more or less work."""
    finish = make_finish(BOB, 0.08)
    depths = [one.finish.depth_mm for one in outcomes_of(finish) if one.finish is not None]
    assert depths == pytest.approx([0.08, 0.064, 0.096])
    by_hand = outcomes_of(replace(finish, off_doses=None, off_orders=(0.75, 1.25)))
    assert len(by_hand) == 5


def solve_contact(gap: np.ndarray, cell: float, modulus: float, depth: float) -> np.ndarray:
    """Return pressure (n, n) of a half space under a rigid shape: Polonsky and Keer's iteration, here with a fixed
    approach, on a grid padded to twice its side.
    """
    n = gap.shape[0]
    k = 2 * np.pi * np.fft.fftfreq(2 * n, cell)
    with np.errstate(divide="ignore"):
        spectrum = 2.0 / (modulus * np.hypot(k[:, None], k))
    spectrum[0, 0] = 0.0
    x = cell * np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n))
    away = np.hypot(x[:, None], x)
    away[0, 0] = 1.0
    green = cell**2 / (np.pi * modulus * away)  # a load on a cell, seen from afar
    green[0, 0] = cell * 4 * np.log(1 + np.sqrt(2)) / (np.pi * modulus)  # and at its own middle
    transform = np.fft.rfft2(green)

    def sink(pressure: np.ndarray) -> np.ndarray:
        padded = np.zeros((2 * n, 2 * n))
        padded[:n, :n] = pressure
        return np.fft.irfft2(np.fft.rfft2(padded) * transform)[:n, :n]

    pressure = np.where(gap < depth, 0.1, 0.0)
    direction, before = np.zeros_like(pressure), 1.0
    for _ in range(200):
        miss = sink(pressure) - (depth - gap)
        pressed = pressure > 0
        square = float((miss[pressed] ** 2).sum())
        if square < 1e-18 * pressed.sum():
            break
        direction = np.where(pressed, miss + square / before * direction, 0.0)
        before = square
        along = sink(direction)
        step = float((miss * direction)[pressed].sum() / (along * direction)[pressed].sum())
        pressure = np.maximum(pressure - step * direction, 0.0)
        late = (pressure == 0) & (miss < 0)
        if late.any():
            pressure[late] -= step * miss[late]
            before = 1e300
    return pressure


@pytest.mark.parametrize(("waves", "within"), [(1.25, 0.08), (2.5, 0.02), (5.0, 0.02), (8.0, 0.05)])
def test_ripples_fall_as_the_exact_contact_says(waves: float, within: float) -> None:
    """A ball is pressed on a ripple at eight phases, by a contact solved without Hertz's formulas; the ripple in what
    comes off gives the finish's exponent for each depth. waves: k times the contact radius.
    """
    n, radius, depth, modulus = 96, 3.0, 0.3, 1.0
    contact = np.sqrt(radius * depth)
    cell = 3.2 * contact / n
    x = cell * (np.arange(n) - n / 2 + 0.5)
    ball = (x[:, None] ** 2 + x**2) / (2 * radius)
    k, high = waves / contact, 1e-3
    volumes, ripples = [], []
    for phase in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        wave = np.cos(k * x + phase)
        pressure = solve_contact(ball - high * wave, cell, modulus, depth)
        volumes.append(pressure.sum())
        ripples.append(2 * (pressure * wave).sum())
    fall = np.mean(ripples) / np.mean(volumes) / high  # per depth: -d ln(height) / dD
    bob = Bob(radius_mm=radius, modulus_mpa=modulus, wear_per_mpa=1.0, compression_mm=depth, spindle_rpm=1.0)
    finish = make_finish(bob, 1.0)
    assert fall == pytest.approx((k / finish.k0_rad_per_mm) ** finish.order, rel=within)
    assert np.mean(volumes) * cell**2 == pytest.approx(bob.force_n, rel=0.02)


def test_dwell_takes_off_evenly_on_slopes() -> None:
    """On a dome the speed of rubbing grows sixfold from its top: an even dwell is off by half, the planned one by 2 %.
    The top itself is left out: at the axis nothing slides.
    """
    x = np.linspace(0.0, 12.0, 49)
    z = -0.1 - ((x[:, None] - 6) ** 2 + (x - 6) ** 2) / (2 * 14.0)
    lens = Heightfield(x_mm=x, y_mm=x, z_mm=z)
    spline = lens.spline_with_run_out(6.0)
    side = np.arange(-2.0, 14.01, 0.3)
    at = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    height, p, q, *_ = spline.jets(at[:, 0], at[:, 1])
    normal = np.column_stack([-p, -q, np.ones_like(p)]) / np.sqrt(1 + p**2 + q**2)[:, None]
    centre = np.column_stack([at, height]) + (BOB.radius_mm - BOB.compression_mm) * normal
    contacts = Contacts(at_mm=at, tip_mm=centre - [0, 0, BOB.radius_mm], dwell_s=np.full(len(at), 0.05))
    ground = Ground.under(BOB, lens, beyond_mm=2.4)
    even = ground.wear(BOB, contacts)[ground.inside]
    planned = ground.wear(BOB, replace(contacts, dwell_s=ground.plan_dwell(BOB, contacts, 0.08)))[ground.inside]
    assert even.std() > 0.2 * even.mean()
    assert planned.mean() == pytest.approx(0.08, rel=0.01)
    assert planned.std() < 0.03 * planned.mean()
