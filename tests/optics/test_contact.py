"""What a pad takes off where it does not reach everywhere: against other ways to solve it, and the laws it keeps."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from optics.contact import wear_surface
from optics.finish import Finish, finish_lens, level
from optics.heightfield import Array, Heightfield
from tests.optics.witness_photographs import wear_in_steps

FELT = Finish(k0_rad_per_mm=2.0, order=1.0, pad_mm=10.0, depth_mm=0.02)
FINISHES = st.builds(
    Finish,
    k0_rad_per_mm=st.floats(0.7, 8.0),
    order=st.sampled_from([0.75, 1.0, 1.5, 2.0, 4.0]),
    pad_mm=st.floats(3.0, 30.0),
    depth_mm=st.floats(1e-3, 0.05),
)
ROUGH = st.tuples(st.integers(0, 2**31), st.integers(9, 40), st.integers(9, 40), st.floats(0.05, 0.4))


def nodes(shape: tuple[int, int]) -> Array:
    """Return the part of the surface that each node of a mirrored grid stands for; their sum is 1."""
    down, across = (np.array([0.5, *[1.0] * (n - 2), 0.5]) / (n - 1) for n in shape)
    return down[:, None] * across[None, :]


def wavy(shape: tuple[int, int], *, seed: int) -> Array:
    """Return waves of all lengths, the longer the higher, of rms 1."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    for axis in (0, 1):
        noise = noise + np.roll(noise, 1, axis) + np.roll(noise, 2, axis)
    return (noise - noise.mean()) / noise.std()


@given(rough=ROUGH, finish=FINISHES, height_mm=st.floats(1e-4, 2.0), steps=st.integers(1, 4))
@settings(max_examples=60, deadline=None)
def test_nothing_is_ever_added_and_the_depth_comes_off(
    rough: tuple[int, int, int, float], finish: Finish, height_mm: float, steps: int
) -> None:
    seed, ny, nx, cell_mm = rough
    kept = finish.multipliers((ny, nx), (cell_mm, cell_mm))
    worn = wear_in_steps(height_mm * wavy((ny, nx), seed=seed), kept, finish.depth_mm, steps=steps)
    assert worn.removal_mm.min() >= 0.0
    assert (worn.removal_mm * nodes((ny, nx))).sum() == pytest.approx(finish.depth_mm, rel=1e-9)
    assert worn.residual < 0.01


@given(rough=ROUGH, finish=FINISHES, steps=st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_where_it_touches_everywhere_the_law_is_linear(
    rough: tuple[int, int, int, float], finish: Finish, steps: int
) -> None:
    """H is the limit for small marks, in as many steps as one likes."""
    seed, ny, nx, cell_mm = rough
    kept = finish.multipliers((ny, nx), (cell_mm, cell_mm))
    heights = 0.1 * finish.depth_mm / steps * wavy((ny, nx), seed=seed)  # no wave of them exceeds what comes off
    worn = wear_in_steps(heights, kept, finish.depth_mm, steps=steps)
    assert worn.touched.all()
    np.testing.assert_allclose(
        worn.removal_mm, heights - level(heights, kept) + finish.depth_mm, atol=1e-6 * finish.depth_mm
    )


def cosines(count: int) -> Array:
    """Return (node, wave) of the cosines that mirror a grid at both ends."""
    at = np.arange(count)
    return np.cos(np.pi * at[:, None] * at[None, :] / (count - 1))


def matrix_of(multipliers: Array) -> Array:
    """Return the dense matrix of a product with multipliers of cosine waves: no transform."""
    both = np.kron(cosines(multipliers.shape[0]), cosines(multipliers.shape[1]))
    return both @ (multipliers.reshape(-1, 1) * np.linalg.inv(both))


def press_by_force(heights_mm: Array, compliance: Array, weights: Array) -> Array:
    """Return pressures q >= 0, mean 1, that least squares with constraints find: of q K q / 2 - z q."""
    flat, w = heights_mm.ravel() - heights_mm.max(), weights.ravel()
    dense = w[:, None] * matrix_of(compliance)
    stiff = np.vstack([np.linalg.cholesky((dense + dense.T) / 2).T, 1e3 * w[None, :]])
    wanted = np.concatenate([np.linalg.solve(stiff[:-1].T, w * flat), [1e3]])
    return nnls(stiff, wanted)[0].reshape(heights_mm.shape)


@pytest.mark.parametrize("order", [1.0, 2.0])
@pytest.mark.parametrize("height_mm", [0.01, 0.05, 0.3])
def test_many_small_explicit_steps_of_preston_by_dense_matrices_agree(order: float, height_mm: float) -> None:
    """Other unknowns (pressures, not gaps), another solver, another way through time; a pad of K(k) = -D / ln(kept)."""
    shape, cell_mm, many = (11, 13), 0.4, 80
    finish = replace(FELT, order=order)
    kept, weights = finish.multipliers(shape, (cell_mm, cell_mm)), nodes(shape)
    compliance = np.full(shape, 1.0)
    compliance.flat[1:] = -finish.depth_mm / np.log(kept.flat[1:])
    z = start = height_mm * wavy(shape, seed=5)
    for _ in range(many):
        z = z - finish.depth_mm / many * press_by_force(z, compliance, weights)
    off = start - z
    assert (off * weights).sum() == pytest.approx(finish.depth_mm, rel=1e-3)
    for steps, most in ((2, 0.06), (8, 0.03)):
        worn = wear_in_steps(start, kept, finish.depth_mm, steps=steps)
        assert np.abs(worn.removal_mm - off).max() < most * off.max()
        assert worn.touched.mean() == pytest.approx((off > 1e-3 * off.max()).mean(), abs=0.05)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_wave_is_touched_as_westergaard_found(share: float) -> None:
    """p* = pi E a / L closes a wave on a half space; P touches 2/pi asin(sqrt(P / p*)) of it (Johnson 1987)."""
    count, periods, k0, moment = 1025, 4, 2.0, 1e-3
    k = np.pi * np.arange(count) / 20.0
    wave = 2 * periods
    full = math.sin(math.pi / 2 * share) ** 2  # P / p*
    height_mm = 0.02 * k0 / k[wave] / full  # p* / P = height / K(k)
    heights = np.tile(height_mm * np.cos(np.pi * wave * np.arange(count) / (count - 1)), (3, 1))
    kept = np.exp(-moment * np.hypot(k[None, :], 1e3 * np.arange(3)[:, None]) / k0)
    worn = wear_in_steps(heights, kept, 0.02 * moment, steps=1)
    assert worn.touched.mean() == pytest.approx(share, abs=0.02)


def test_what_is_higher_is_touched_less() -> None:
    """The tool hangs over more of a deeper relief."""
    waves = wavy((60, 60), seed=2)
    kept = FELT.multipliers(waves.shape, (0.2, 0.2))
    shares = [wear_surface(h * waves, kept, 0.02).touched.mean() for h in (0.005, 0.02, 0.08, 0.3, 1.2)]
    assert shares[0] == 1.0
    assert all(deeper < before for before, deeper in pairwise(shares))


@pytest.mark.parametrize(("times", "least_left"), [(0.5, 0.0), (0.95, 0.0), (3.0, 0.25), (20.0, 0.8)])
def test_smoothing_ends_at_a_limit_that_grows_with_the_pressure(times: float, least_left: float) -> None:
    """A wave higher than the compliance A keeps its valleys, though H would leave 1.5 % of it."""
    axis = np.linspace(0.0, 24.0, 241)
    finish = replace(FELT, k0_rad_per_mm=0.5, pad_mm=24.0)
    k = 2 * np.pi / 3.0
    first = 4 / 7  # of three steps
    bound_mm = first * finish.depth_mm / (1.0 - float(finish.compute_kept(k)) ** first)
    lens = Heightfield(
        x_mm=axis, y_mm=axis, z_mm=np.tile(times * bound_mm * (np.cos(k * axis) - 1.0), (axis.size, 1)), rim_mm=50.0
    )
    assert finish.transfer(k) < 0.02
    done = finish_lens(lens, finish)
    middle = np.s_[80:161, 80:161]
    left = np.ptp(done.lens.z_mm[middle]) / lens.relief_mm
    assert left > least_left
    if not least_left:
        assert done.contact_share == 1.0
        assert left < 0.03
        return
    assert done.contact_share < 0.95
    harder = finish_lens(lens, replace(finish, depth_mm=2.0 * times * finish.depth_mm))  # more pressure, H as before
    assert harder.contact_share == 1.0


@given(rough=ROUGH, finish=FINISHES)
@settings(max_examples=20, deadline=None)
def test_a_film_keeps_the_volume(rough: tuple[int, int, int, float], finish: Finish) -> None:
    """Lacquer, melt and swollen skin flow from ridges into valleys, and the mean height stays."""
    seed, ny, nx, cell_mm = rough
    waves = wavy((ny, nx), seed=seed) + 3.0
    left = level(waves, finish.multipliers((ny, nx), (cell_mm, cell_mm)))
    assert (left * nodes((ny, nx))).sum() == pytest.approx((waves * nodes((ny, nx))).sum(), rel=1e-12)


def creased(depth_mm: float) -> Heightfield:
    """Return a lens with a ring of a crease, as the edge of a black disc asks for."""
    axis = np.linspace(0.0, 20.0, 201)
    x, y = np.meshgrid(axis - 10.0, axis - 10.0)
    ring = np.exp(-(((np.hypot(x, y) - 5.0) / 0.4) ** 2))
    return Heightfield(x_mm=axis, y_mm=axis, z_mm=-1.0 - depth_mm * ring, rim_mm=50.0)


def test_a_finish_by_contact_never_adds_and_says_what_it_touches() -> None:
    """The linear law would fill the crease by a tenth of a millimetre; a pad leaves it as it is."""
    lens = creased(0.5)
    done = finish_lens(lens, FELT)
    off = lens.z_mm - done.lens.z_mm
    bottom = lens.z_mm < -1.45
    assert np.ptp(off[bottom]) < 1e-9
    assert off[bottom].min() == pytest.approx(off.min(), abs=1e-9)
    assert 0.7 < done.contact_share < 0.97
    filled = finish_lens(lens, replace(FELT, depth_mm=None)).lens
    added = (filled.z_mm - filled.z_mm[0, 0]) - (lens.z_mm - lens.z_mm[0, 0])
    assert added[bottom].mean() > 0.1
    assert finish_lens(lens, replace(FELT, depth_mm=None)).contact_share == 1.0
    assert finish_lens(creased(0.005), FELT).contact_share == 1.0


def test_marks_stay_where_the_tool_does_not_reach() -> None:
    lens, finer, beyond = creased(0.5), 2, 20
    x = np.arange(400 + 1 + 2 * beyond)
    marks = np.broadcast_to(1e-3 * np.cos(2 * np.pi * x / 8.0), (x.size, x.size))
    with_marks = finish_lens(lens, FELT, departure_mm=marks, finer=finer, beyond_cells=beyond).lens
    alone = finish_lens(lens, FELT, finer=finer).lens
    left = with_marks.z_mm - alone.z_mm
    bottom = alone.z_mm < alone.z_mm.max() - 0.47
    assert left[bottom].std() > 0.9e-3 / math.sqrt(2.0)
    assert left[:40, :40].std() < 0.1e-3


def test_a_depth_of_nothing_is_no_contact() -> None:
    with pytest.raises(ValueError, match="depth_mm"):
        replace(FELT, depth_mm=0.0)
