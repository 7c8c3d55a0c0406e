"""surface.bin against the lens."""

from __future__ import annotations

import numpy as np
import pytest

from optics.heightfield import Heightfield
from service.job.page_data.surface import header_line, surface_bytes
from tests.service.job.page_data.paths import split_header

WIDTH_MM, HEIGHT_MM = 30.0, 20.0


@pytest.fixture(scope="module")
def lens() -> Heightfield:
    """A dome off the middle, on a grid of its own: no mirror of it looks the same."""
    y, x = np.mgrid[0:81, 0:121] / 4.0
    z = -1.0 - 0.02 * ((x - 12) ** 2 + (y - 8) ** 2) / 2
    return Heightfield.on_aperture(z, width_mm=WIDTH_MM, height_mm=HEIGHT_MM)


@pytest.mark.parametrize("length", range(20))
def test_arrays_begin_at_a_multiple_of_eight(length: int) -> None:
    line = header_line({"name": "a" * length})
    assert len(line) % 8 == 0
    assert line.endswith(b"\n")
    assert split_header(line + b"\n123") == ({"name": "a" * length}, len(line))


def test_the_surface_is_the_lens_to_its_step(lens: Heightfield) -> None:
    data = surface_bytes(lens, thickness_mm=20.0, margin_mm=5.0, outline_mm=None)
    facts, start = split_header(data)
    z = np.frombuffer(data, "<u2", offset=start).reshape(facts["ny"], facts["nx"])
    assert (facts["nx"], facts["ny"]) == (257, 172)
    x = facts["x0_mm"] + facts["dx_mm"] * np.arange(facts["nx"])
    y = facts["y0_mm"] + facts["dy_mm"] * np.arange(facts["ny"])
    assert (x[-1], y[-1]) == (pytest.approx(WIDTH_MM), pytest.approx(HEIGHT_MM))
    wanted = -1.0 - 0.02 * ((x[None, :] - 12) ** 2 + (y[:, None] - 8) ** 2) / 2
    assert np.abs(facts["z0_mm"] + facts["dz_mm"] * z - wanted).max() <= 0.51 * facts["dz_mm"]


def test_a_flat_lens_has_no_steps() -> None:
    flat = Heightfield.on_aperture(np.full((9, 9), -0.5), width_mm=10.0, height_mm=10.0)
    facts, start = split_header(
        data := surface_bytes(flat, thickness_mm=9.0, margin_mm=1.0, outline_mm=[[0, 0], [1, 0]])
    )
    assert (facts["z0_mm"], facts["dz_mm"]) == (pytest.approx(-0.5), pytest.approx(0.0, abs=1e-15))
    assert len(data) == start + 2 * 257 * 257
