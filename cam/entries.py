"""How the tool comes down: by rapid to over the block, at the plunge feed to just above the stock, then on a ramp."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil, radians, tan

import numpy as np

from cam.moves import Array, Path, cut, rapid
from cam.passes import PassSpec
from cam.vertices import thinned

RAMP_SLOPE = tan(radians(3.0))
RAMP_STRETCH_MM = 15.0
STRAIGHT_MM = 1e-6
"""Points this near to a straight line are not written: a leg of a ramp is one move until it meets the path."""

RAPID_CLEARANCE_MM = 1.0
"""Above the stock as it is known, and never under the top of the block, where a rapid straight down ends."""

CLEARANCE_MM = 0.1
"""Above the stock as it is known, where feeding straight down ends."""


def enter(polyline_mm: Array, stock_mm: float, spec: PassSpec, *, safe_z_mm: float) -> Iterator[Path]:
    """From safe height to the first point of a polyline (n, 3), its first stretch cut on the way.

    stock_mm : tip height at which the ball would meet stock above the first point; at or below that point: air
    """
    x, y, z = polyline_mm[0]
    over_mm = max(stock_mm, z, 0.0) + RAPID_CLEARANCE_MM
    yield rapid((x, y, safe_z_mm), (x, y, over_mm)) if over_mm < safe_z_mm else rapid((x, y, safe_z_mm))
    if stock_mm <= z:
        yield cut([polyline_mm[0]], spec.plunge_mm_per_min)
        return
    start_mm = min(stock_mm + CLEARANCE_MM, safe_z_mm)
    yield cut([(x, y, start_mm)], spec.plunge_mm_per_min)
    yield cut(ramp(polyline_mm, start_mm), spec.plunge_mm_per_min)


def leave(x_mm: float, y_mm: float, *, safe_z_mm: float) -> Path:
    """Straight up."""
    return rapid((x_mm, y_mm, safe_z_mm))


def ramp(polyline_mm: Array, start_mm: float) -> Array:
    """(m, 3) there and back on the first stretch, sinking at RAMP_SLOPE, never below the polyline, to its start.

    The polyline is straight from above, along X or along Y. Long drops over short polylines go back and forth often.
    Where the path is higher than the ramp the tool follows the path.
    """
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(polyline_mm[:, :2], axis=0).T))])
    longest = min(float(run[-1]), RAMP_STRETCH_MM)
    near = run <= longest
    last = np.array([np.interp(longest, run, polyline_mm[:, 2])])
    drop = start_mm - float(np.concatenate([polyline_mm[near, 2], last]).min())
    travel = drop / RAMP_SLOPE
    legs = 2 * ceil(travel / (2 * longest))
    stretch = travel / legs
    inner = run[(run > 0) & (run < stretch)]
    places = np.union1d(np.linspace(0.0, stretch, max(3, ceil(stretch / 0.25) + 1)), inner)
    path = np.column_stack([np.interp(places, run, polyline_mm[:, a]) for a in range(3)])
    along = 0 if np.ptp(polyline_mm[:, 0]) > 0 else 1
    sunk: list[Array] = []
    for leg in range(legs):
        way, done = (path, places) if leg % 2 == 0 else (path[::-1], stretch - places[::-1])
        points = way.copy()
        points[:, 2] = np.maximum(way[:, 2], start_mm - RAMP_SLOPE * (leg * stretch + done))
        sunk.append(thinned(points, STRAIGHT_MM, along=along))
    sunk[-1][-1] = polyline_mm[0]
    return np.concatenate(sunk)
