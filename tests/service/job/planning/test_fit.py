"""Cutters that cannot do a job are refused before any work, by the key to change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cam.passes import ball_pass
from optics.heightfield import Heightfield
from service.errors import InputError
from service.job.planning.fit import require_flutes

SPEC = ball_pass("finish", radius_mm=0.5, pitch_mm=0.1, stock_to_leave_mm=0.0, step_down_mm=0.4)


@pytest.fixture(scope="module")
def ridge() -> Heightfield:
    """A ridge with sides of slope 1, 1.5 mm high."""
    x, y = np.meshgrid(np.linspace(0, 8, 81), np.linspace(0, 6, 61))
    return Heightfield.on_aperture(-0.1 - np.minimum(np.abs(x - 4.0), 1.5) + 0 * y, width_mm=8, height_mm=6)


def test_what_is_not_stated_is_not_asked(ridge):
    require_flutes(ridge, (SPEC, SPEC))


def test_flutes_shorter_than_one_bite_are_refused(ridge):
    with pytest.raises(InputError, match=r"passes\.1\.flute_length_mm: 0\.3 mm .* at least the step-down of 0\.4"):
        require_flutes(ridge, (SPEC, replace(SPEC, flute_length_mm=0.3)))


def test_a_thick_shank_beside_the_lens_is_refused_with_the_length_that_would_do(ridge):
    thick = replace(SPEC, flute_length_mm=0.5, shank_radius_mm=1.5)
    with pytest.raises(InputError, match=r"passes\.0\.flute_length_mm: .* radius 1\.5 mm") as refused:
        require_flutes(ridge, (thick,))
    enough = float(str(refused.value).split("at least ")[1].split(" mm")[0])
    require_flutes(ridge, (replace(thick, flute_length_mm=enough + 0.1),))
    require_flutes(ridge, (replace(thick, shank_radius_mm=None),))
