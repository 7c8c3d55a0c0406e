"""Laws across all features at once: a random set-up and a random picture end in a lens, or in an error with a name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from optics.bench import Bench, Screen
from optics.caustic import simulate_caustic
from optics.design import LensDesign, design_lens
from optics.errors import OpticsError
from optics.irradiance import target_irradiance
from optics.lens_settings import LensSettings
from optics.light import Light

pytestmark = pytest.mark.thorough

ANGLES = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
OUTLINES = {  # in units of the aperture
    "ellipse": 0.5 + 0.5 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1),
    "triangle": np.array([[0.0, 0.0], [1.0, 0.0], [0.3, 1.0]]),
    "arrow": np.array([[0.0, 0.0], [0.5, 0.3], [1.0, 0.0], [0.5, 1.0]]),
}


def of_size(draw: st.DrawFn, low: float, high: float) -> float:
    """Any order of magnitude between low and high is as likely as another."""
    return float(10 ** draw(st.floats(np.log10(low), np.log10(high))))


@st.composite
def lights(draw: st.DrawFn) -> Light:
    tilts, strengths = st.floats(-0.3, 0.3), st.lists(st.floats(0.05, 1.0), min_size=6, max_size=6)
    profile = draw(st.none() | strengths)
    return Light(
        kind=draw(st.sampled_from(["collimated", "sun", "point"])),  # type: ignore[arg-type]
        size_deg=draw(st.floats(0.1, 3.0)),
        distance_mm=of_size(draw, 15.0, 5000.0),
        size_mm=draw(st.sampled_from([0.0, 4.0])),
        profile=None if profile is None else np.array(profile).reshape(2, 3),
        tilt_rad=draw(st.just((0.0, 0.0)) | st.tuples(tilts, tilts)),
    )


@st.composite
def benches(draw: st.DrawFn) -> Bench:
    width, height = of_size(draw, 8.0, 60.0), of_size(draw, 8.0, 60.0)
    outline = draw(st.none() | st.sampled_from(sorted(OUTLINES)))
    shifts = st.floats(-40.0, 40.0)
    return Bench.centre_on(
        width_mm=width,
        height_mm=height,
        throw_mm=of_size(draw, 15.0, 400.0),
        refractive_index=draw(st.floats(1.1, 2.4)),
        screen_mm=draw(st.none() | st.just((width * of_size(draw, 0.4, 3.0), height * of_size(draw, 0.4, 3.0)))),
        shift_mm=draw(st.just((0.0, 0.0)) | st.tuples(shifts, shifts)),
        thickness_mm=draw(st.floats(5.0, 50.0)),
        mirror=draw(st.booleans()),
        light=draw(lights()),
        outline_mm=None if outline is None else OUTLINES[outline] * (width, height),
        branch=draw(st.sampled_from(["direct", "direct", "inverted"])),
    )


@st.composite
def pictures(draw: st.DrawFn) -> np.ndarray:
    """Targets of 4 to 20 pixels a side: noise over three decades, black and white, one dot, a soft slope."""
    shape = draw(st.tuples(st.integers(4, 20), st.integers(4, 20)))
    noise = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).random(shape)
    y, x = np.indices(shape)
    kinds = {
        "noise": 10 ** (-3 * noise),
        "black and white": (noise < 0.4) | (noise == noise.min()),
        "dot": noise == noise.max(),
        "slope": 1.0 + x / shape[1] + 0.5 * y / shape[0],
    }
    picture = kinds[draw(st.sampled_from(sorted(kinds)))].astype(float)
    return target_irradiance(picture, viewed_from="lens")


def hold_the_laws(design: LensDesign, settings: LensSettings, shape: tuple[int, ...]) -> None:
    """Finite heights on the asked grid with their top at the skim; all light arrives, or is known to be reflected."""
    lens, bench = design.heightfield, settings.bench
    assert lens.z_mm.shape == tuple(settings.vertices(pixels) for pixels in shape)
    assert lens.z_mm.max() == pytest.approx(-settings.skim_mm, abs=1e-9)
    assert design.message and len(design.history) >= 1
    hall = Screen(width_mm=1e6, height_mm=1e6, centre_x_mm=0.0, centre_y_mm=0.0)
    seen = simulate_caustic(lens, replace(bench, screen=hall), pixels=(8, 8), tubes_per_cell=1, beams=3)
    assert seen.irradiance.min() > -1e-9
    assert seen.irradiance.mean() + seen.reflected_share + seen.outside_share == pytest.approx(1.0, abs=1e-9)
    assert seen.outside_share < 0.01  # grazing rays miss even the hall
    if design.converged:
        assert seen.reflected_share < 0.05


@hypothesis_settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(
    bench=benches(),
    target=pictures(),
    corrections=st.integers(0, 2),
    radius_mm=st.sampled_from([0.0, 0.5, 3.0]),
    polish=st.sampled_from([0, 0, 2]),
)
def test_a_lens_or_a_reason(bench: Bench, target: np.ndarray, corrections: int, radius_mm: float, polish: int) -> None:
    settings = LensSettings(
        bench=bench, skim_mm=0.1, corrections=corrections, min_radius_mm=radius_mm, polish_steps=polish
    )
    try:
        design = design_lens(target, settings)
    except OpticsError as refusal:
        assert len(str(refusal)) > 20
        return
    hold_the_laws(design, settings, target.shape)


def test_a_mirror_whose_lamp_stands_as_far_away_as_its_screen() -> None:
    """The solver divided by zero here; other distances of the lamp, or of the screen, always ended in a lens."""
    light = Light(kind="point", distance_mm=10**2.25, profile=np.array([[0.5, 1.0, 1.0], [0.5, 0.5, 1.0]]))
    bench = Bench.centre_on(
        width_mm=10**1.5,
        height_mm=10.0,
        throw_mm=10**2.25,
        refractive_index=2.0,
        screen_mm=(10**1.5, 10**1.25),
        thickness_mm=5.0,
        mirror=True,
        light=light,
    )
    target = np.zeros((4, 6))
    target[0, 0] = 24.0
    settings = LensSettings(bench=bench, skim_mm=0.1, corrections=2, min_radius_mm=0.0)
    try:
        design = design_lens(target, settings)
    except OpticsError:
        return
    hold_the_laws(design, settings, target.shape)
