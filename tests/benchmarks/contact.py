"""CL points per second and their error, against opencamlib's BatchDropCutter on the same surface in the same run."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from cam.surface.tool_surface import ToolSurface
from tests.benchmarks.pictures import bumps
from tests.benchmarks.timing import Figure, seconds

RADIUS_MM = 0.5
TILE_MM = 10.0


def figures() -> Iterator[Figure]:
    lens = bumps()
    surface = ToolSurface.over(lens, radius_mm=RADIUS_MM)
    x = np.arange(5.0, 95.0, 0.05)
    y = np.arange(40.0, 60.0, 0.02)
    wall, cpu = seconds(lambda: surface.tip_rows_mm(x, y))
    ours = x.size * y.size / cpu
    note = f"{wall:.2f} s wall; asked: 2 (5)"
    yield Figure("CL points, ball R 0.5 on the spline (0.1 mm data)", ours / 1e6, "M/s/thread", note)
    peer = _opencamlib_points_per_second(lens)
    yield Figure("CL points, opencamlib BatchDropCutter, facets 0.1 mm", peer / 1e6, "M/s/thread", "10 mm tile")
    yield Figure("ratio of the two", ours / peer, "x", "asked: 1000")
    yield Figure(
        "CL error against a contact found by brute force", _worst_error_nm(lens, surface), "nm", "worst of 200"
    )


def _opencamlib_points_per_second(lens) -> float:  # type: ignore[no-untyped-def]
    import opencamlib as ocl

    axis = np.arange(0.0, TILE_MM + 1e-9, 0.1) + 45.0
    z = lens.spline().heights_mm(axis[None, :], axis[:, None])
    solid = ocl.STLSurf()
    for j in range(axis.size - 1):
        for i in range(axis.size - 1):
            corners = ((0, 0), (1, 0), (1, 1), (0, 1))
            a, b, c, d = (ocl.Point(axis[i + p], axis[j + q], z[j + q, i + p]) for p, q in corners)
            solid.addTriangle(ocl.Triangle(a, b, c))
            solid.addTriangle(ocl.Triangle(a, c, d))
    cutter = ocl.BallCutter(2 * RADIUS_MM, 10.0)  # kept: the batch holds a bare pointer to it
    batch = ocl.BatchDropCutter()
    batch.setSTL(solid)
    batch.setCutter(cutter)
    batch.setThreads(1)
    inner = np.arange(46.0, 54.0, 0.08)
    for py in inner:
        for px in inner:
            batch.appendPoint(ocl.CLPoint(px, py, -20.0))
    started = time.process_time()
    batch.run()
    return float(inner.size**2 / (time.process_time() - started))


def _worst_error_nm(lens, surface: ToolSurface) -> float:  # type: ignore[no-untyped-def]
    """Against the highest position of a ball over a fine disc of the spline, refined three times around its peak."""
    spline = lens.spline()
    rng = np.random.default_rng(1)
    worst = 0.0
    for cx, cy in rng.uniform(10, 90, (200, 2)):
        x0, y0, half = cx, cy, RADIUS_MM
        for _ in range(8):
            gx, gy = np.meshgrid(x0 + np.linspace(-half, half, 41), y0 + np.linspace(-half, half, 41))
            d2 = (gx - cx) ** 2 + (gy - cy) ** 2
            lift = np.sqrt(np.maximum(RADIUS_MM**2 - d2, 0)) - RADIUS_MM
            tip = np.where(d2 < RADIUS_MM**2, spline.heights_mm(gx, gy) + lift, -np.inf)
            best = np.unravel_index(tip.argmax(), tip.shape)
            x0, y0, half = gx[best], gy[best], half / 8
        worst = max(worst, abs(tip[best] - surface.tip_heights_mm(np.array([cx]), np.array([cy]))[0]))
    return 1e6 * worst
