"""Tips of a written finishing program against the contact on a surface known in closed form, rows and contour."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cam.passes import PAPER_PASSES, PassSpec, Stock
from cam.posts.dialects import GRBL
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from tests.benchmarks.timing import Figure
from tests.cam.programs import generate_program, read_program

SIDE_MM = 20.0
WAVES = ((1.1, 0.21, 0.13, 0.4), (0.5, -0.15, 0.34, 1.3), (0.02, 1.3, 0.9, 0.2))  # height, along x, along y, phase


def heights(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z and its slopes: slopes up to 0.4, curvature up to 0.15 /mm."""
    z, zx, zy = np.full(np.broadcast(x, y).shape, -2.0), 0.0, 0.0
    for high, along, across, phase in WAVES:
        angle = along * x + across * y + phase
        z = z + high * np.sin(angle)
        zx = zx + high * along * np.cos(angle)
        zy = zy + high * across * np.cos(angle)
    return z, zx, zy


def tip_heights(x: np.ndarray, y: np.ndarray, radius_mm: float) -> np.ndarray:
    """Of the ball that touches at p: p = tip + R grad z / q, a contraction while R times the curvature is below 1."""
    u, v = x.copy(), y.copy()
    for _ in range(40):
        z, zx, zy = heights(u, v)
        q = np.sqrt(1 + zx**2 + zy**2)
        u, v = x + radius_mm * zx / q, y + radius_mm * zy / q
    z, zx, zy = heights(u, v)
    return z + radius_mm / np.sqrt(1 + zx**2 + zy**2) - radius_mm


def _on_the_lens(batch: MoveBatch, spec: PassSpec) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Tips at the ends of cutting moves and half way along them, whose balls touch well inside the aperture."""
    cuts = ~batch.is_rapid & (batch.feed_mm_per_min == spec.feed_mm_per_min)
    for points in (batch.end_mm[cuts], 0.5 * (batch.start_mm + batch.end_mm)[cuts]):
        inside = (np.abs(points[:, :2] - SIDE_MM / 2) < SIDE_MM / 2 - spec.radius_mm).all(axis=1)
        yield points[inside], tip_heights(points[inside, 0], points[inside, 1], spec.radius_mm)


def figures() -> Iterator[Figure]:
    axis = np.linspace(0, SIDE_MM, round(10 * SIDE_MM) + 1)
    lens = Heightfield.on_aperture(heights(axis[None, :], axis[:, None])[0], width_mm=SIDE_MM, height_mm=SIDE_MM)
    stock = Stock(width_mm=SIDE_MM, height_mm=SIDE_MM, thickness_mm=20.0, margin_mm=5.0)
    block = StockGrid.block(stock, 0.1)
    skin = lens.spline().extend(8.0).heights_mm(block.x_mm[None, :], block.y_mm[:, None]) + 0.03
    left = replace(block, top_mm=np.minimum(skin, 0.0))
    for strategy in ("raster", "contour"):
        spec = replace(PAPER_PASSES[2], strategy=strategy)
        text = list(generate_program(lens, spec, stock, stock_top=left, post=GRBL))
        squares, count, deepest, worst = 0.0, 0, 0.0, 0.0
        for batch in read_program(text):
            (ends, at_ends), (middles, at_middles) = _on_the_lens(batch, spec)
            error = ends[:, 2] - at_ends
            settled = np.abs(error) < 1e-4  # not on the entry's ramp
            squares += float((error[settled] ** 2).sum())
            count += int(settled.sum())
            worst = max(worst, float(np.abs(error[settled]).max(initial=0.0)))
            deepest = max(deepest, float(np.concatenate([at_ends - ends[:, 2], at_middles - middles[:, 2]]).max()))
        note = f"{count:,} vertices of the file, worst {1e6 * worst:.1f} nm; asked: 3"
        words = f"{strategy} finish at pitch {spec.pitch_mm:g} of a closed form (0.1 mm data)"
        yield Figure(f"{words}: CL error rms", 1e6 * math.sqrt(squares / max(count, 1)), "nm", note)
        yield Figure(f"{words}: deepest cut", 1e6 * deepest, "nm", "ends and middles of all moves; asked: 20")
