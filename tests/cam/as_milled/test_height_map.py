"""The map of a milled surface over its lens, against every ball of the path and against what a finish must not see."""

from __future__ import annotations

import numpy as np
import pytest

from cam.as_milled.height_map import map_departure
from cam.as_milled.tracks import Noise
from tests.cam.as_milled.test_as_milled import lens
from tests.cam.as_milled.test_as_milled_brute_force import crossed, lowest_ball, near_the_window
from tests.cam.programs import row_tracks


@pytest.mark.parametrize("path", ["rows", "rows across rows"])
def test_cells_are_the_mean_of_the_lowest_ball(path: str) -> None:
    """64 places of each cell by brute force; four by lot differ from them by what a groove spreads."""
    over, radius, pitch = lens(tilt=(0.3, -0.2), bend=(0.25, -0.1)), 0.5, 0.05
    tracks = row_tracks(over, radius_mm=radius, pitch_mm=pitch) if path == "rows" else crossed(over, radius, pitch)
    tracks = tracks.run_on_mill(step_mm=0.002, noise=Noise(sigma_mm=5e-4))
    found = map_departure([tracks], over, pitch_mm=pitch, error_mm=1e-3, finer=1)
    near, spline = near_the_window(tracks, 0.6), over.spline()
    offset = (np.arange(8) + 0.5) / 8 - 0.5
    apart = []
    for j in range(16, 24, 2):
        for i in range(14, 22, 2):
            x, y = np.meshgrid(over.x_mm[i] + offset * over.dx_mm, over.y_mm[j] + offset * over.dy_mm)
            brute = lowest_ball(near, x.ravel(), y.ravel()) - spline.heights_mm(x.ravel(), y.ravel())
            apart.append(found.departure_mm[j, i] - brute.mean())
            assert abs(apart[-1]) < 2.0 * brute.std() + 1e-6  # the mean of four: half of that by lot
    assert abs(np.mean(apart)) < 1e-4
    assert found.departure_mm.all()  # all of the aperture is cut


def test_even_rows_make_no_long_waves() -> None:
    """Rows 0.05 mm apart under cells of 0.049: on a lattice they would beat, 0.3 um high over 2 mm."""
    over, pitch = lens(side_mm=1.96), 0.05  # cells of 0.049 mm
    tracks = row_tracks(over, radius_mm=0.5, pitch_mm=pitch)
    departure = map_departure([tracks], over, pitch_mm=pitch, finer=1).departure_mm[4:-4, 4:-4]
    across = departure.mean(axis=1)  # what is alike along the rows
    assert across.std() < 4e-5


def test_a_valley_that_the_ball_does_not_fit_is_filled_by_it() -> None:
    """A crease of 0.5 to a side under a ball of 1 mm: over it the ball stands 1 (sqrt(1 + 0.25) - 1) high."""
    over = lens()
    x = over.x_mm - 1.0
    steep = type(over)(x_mm=over.x_mm, y_mm=over.y_mm, z_mm=np.tile(0.5 * np.abs(x), (over.y_mm.size, 1)) - 1.0)
    tracks = row_tracks(steep, radius_mm=1.0, pitch_mm=0.05, direction="y")
    found = map_departure([tracks], steep, pitch_mm=0.05, finer=1)
    middle = found.departure_mm[over.y_mm.size // 2, over.x_mm.size // 2]
    assert found.departure_mm.all()  # all of the aperture is cut
    assert middle == pytest.approx(np.sqrt(1.25) - 1.0, rel=0.15)


def test_beside_the_cut_nothing_departs() -> None:
    over = lens()
    tracks = row_tracks(over, radius_mm=0.3, pitch_mm=0.03)
    found = map_departure([tracks], over, pitch_mm=0.03, beyond_mm=1.5)
    assert found.departure_mm.shape[0] == (over.y_mm.size - 1) * found.finer + 1 + 2 * found.beyond_cells
    assert not found.departure_mm[:10].any() and not found.departure_mm[:, -10:].any()
