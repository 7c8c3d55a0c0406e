"""Speeds and feeds: the spindle follows the feed, so that chips stay within the band of the material."""

from __future__ import annotations

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.materials import LEAST_FEED, MATERIALS, PMMA, SLOT_FEED
from cam.tools import Speeds, Tool

ROUNDED = 1.01  # speeds are whole tens, feeds whole
RATES = (5000.0, 5000.0, 1500.0)


def tool(radius_mm: float, flutes: int, max_rpm: float = 40_000.0) -> Tool:
    return Tool(
        name="own", radius_mm=radius_mm, flutes=flutes, flute_length_mm=20.0, shank_radius_mm=radius_mm,
        stick_out_mm=40.0, max_rpm=max_rpm, cost_class=1,
    )  # fmt: skip


@given(
    material=st.sampled_from(sorted(MATERIALS)),
    radius_mm=st.floats(0.25, 6.0),
    flutes=st.integers(1, 4),
    feed=st.floats(50.0, 5000.0),
    finishes=st.booleans(),
    slowest=st.floats(50.0, 9000.0),
    fastest=st.floats(9000.0, 40_000.0),
)
def test_the_spindle_follows_the_feed(material, radius_mm, flutes, feed, finishes, slowest, fastest):
    """No chip is thicker than the band, and none of the slowest stretches thinner, unless the spindle cannot."""
    start = MATERIALS[material].start_values(radius_mm)
    rpm = start.choose_rpm(feed, flutes, finishes=finishes, spindle_rpm=(slowest, fastest))
    least_mm, most_mm = start.chip_mm
    assert slowest <= rpm <= fastest
    assert rpm == fastest or feed / (rpm * flutes) <= most_mm * ROUNDED
    if slowest < rpm < fastest and feed / (rpm * flutes) < 0.99 * most_mm:
        slow = feed * (SLOT_FEED if finishes else LEAST_FEED)
        narrow = not finishes and LEAST_FEED * most_mm < 1.5 * least_mm  # feeds rise by half; 0.3 is slowest
        slow = feed * 1.5 * least_mm / most_mm if narrow else slow
        assert slow / (rpm * flutes) >= least_mm / ROUNDED


@pytest.mark.parametrize("radius_mm", [0.25, 0.5, 1.0, 1.5, 3.0, 6.0])
def test_one_flute_halves_the_feed(radius_mm):
    one, two = (
        Speeds.of(tool(radius_mm, n), PMMA, spindle_rpm=(50, 30_000), max_rate_mm_per_min=RATES) for n in (1, 2)
    )
    assert one.feed_mm_per_min == pytest.approx(two.feed_mm_per_min / 2, abs=1)
    assert one.spindle_rpm == pytest.approx(two.spindle_rpm, abs=100)  # the chip, and so the speed, stays


def test_a_feed_that_the_link_carries_slows_the_spindle_too():
    """F236 instead of F800, as an Okuma at 9600 baud: chips as thick as before."""
    mill = {"spindle_rpm": (50.0, 8000.0), "max_rate_mm_per_min": RATES, "finishes": True}
    free, slow = (Speeds.of(tool(3.0, 2), PMMA, **mill, carried_mm_per_min=carried) for carried in (inf, 236.0))
    assert (free.feed_mm_per_min, slow.feed_mm_per_min) == (800.0, 236.0)
    assert SLOT_FEED * 236.0 / (2 * slow.spindle_rpm) >= PMMA.start_values(3.0).chip_mm[0] / ROUNDED


@pytest.mark.parametrize("name", sorted(MATERIALS))
def test_every_material_has_sources_and_bands_around_its_start_values(name):
    material = MATERIALS[name]
    assert material.sources and material.makers
    assert (material.refractive_index is None) == (material.reflectance is not None)
    for row in material.cutting:
        assert row.chip_mm[0] < row.feed_mm_per_tooth < row.chip_mm[1]
    for _, diameter_mm, least_mm, most_mm in material.makers:  # theirs and ours meet
        ours = material.start_values(diameter_mm / 2).chip_mm
        assert least_mm <= ours[1] * 1.05 and most_mm >= ours[0] * 0.95
