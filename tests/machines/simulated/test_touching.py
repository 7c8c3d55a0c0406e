"""What a probe of the simulated mill touches: a plate on a corner, from above, from the left and from the front."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, sqrt

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from machines.simulated.controller import find_contact
from machines.simulated.traits import GRBL_11, CornerPlate

LEFT_MM, FRONT_MM, TOP_MM, RADIUS_MM = -10.0, -20.0, -5.0, 1.5
PLATE = CornerPlate(left_mm=LEFT_MM, front_mm=FRONT_MM, tool_radius_mm=RADIUS_MM)
WITH_PLATE = replace(GRBL_11, probe_surface_mm=TOP_MM, corner_plate=PLATE)
coordinates = st.floats(-40.0, 20.0)


@given(coordinates, st.floats(-20.0, 5.0), st.sampled_from(["X", "Y"]), st.booleans())
@example(FRONT_MM - 1.0, -7.0, "X", False)
@example(LEFT_MM - 1.0, -7.0, "Y", True)
def test_a_side_is_touched_with_the_cutters_side_and_past_the_corner_not_at_all(
    other_mm: float, z_mm: float, axis: str, away: bool
) -> None:
    """The same place is found on the way to the plate and on the way from it, in coordinates that are shifted, too."""
    face_mm, end_mm = (LEFT_MM, FRONT_MM) if axis == "X" else (FRONT_MM, LEFT_MM)
    shift = (100.0, -50.0, 7.0)
    way = [(at, other_mm, z_mm) if axis == "X" else (other_mm, at, z_mm) for at in (-60.0, 30.0)]
    start, end = ((x - shift[0], y - shift[1], z - shift[2]) for x, y, z in (reversed(way) if away else way))
    found = find_contact(WITH_PLATE, start, end, shift_mm=shift)
    past_mm = max(end_mm - other_mm, 0.0)
    if z_mm >= TOP_MM - 1e-9 or past_mm >= RADIUS_MM - 1e-9:
        assert found is None
        return
    k = "XY".index(axis)
    assert found is not None
    touched_mm = face_mm - sqrt(RADIUS_MM**2 - past_mm**2)
    assert found[k] + shift[k] == pytest.approx(touched_mm, abs=1e-4)  # noise is amplified where a cutter just grazes


@given(coordinates, coordinates)
def test_the_top_is_touched_wherever_the_cutter_is_over_it(x: float, y: float) -> None:
    found = find_contact(WITH_PLATE, (x, y, 0.0), (x, y, -30.0), shift_mm=(0.0, 0.0, 0.0))
    outside_mm = hypot(max(LEFT_MM - x, 0.0), max(FRONT_MM - y, 0.0))
    assert found == (pytest.approx((x, y, TOP_MM)) if outside_mm < RADIUS_MM - 1e-9 else None)
