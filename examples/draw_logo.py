"""Draws examples/logo.png: hard white shapes on black, a hard case for a lens.   python examples/draw_logo.py [FILE]

A toothed sun, a convex lens below it, and the light behind the lens: beams that run together into one bright point.
"""

import math
import sys
from pathlib import Path

from PIL import Image, ImageDraw

SIDE = 512
FINE = 8  # drawn this much larger, then averaged: edges end up one pixel wide
CENTRE_X, SUN_Y, FOCUS_Y = 256.0, 142.0, 482.0
LENS_Y, LENS_HALF_WIDTH, LENS_HALF_DEPTH = 321.0, 236.0, 42.0

Point = tuple[float, float]


def turned(radius: float, angle: float) -> Point:
    return CENTRE_X + radius * math.sin(angle), SUN_Y - radius * math.cos(angle)


def sun_teeth(count: int = 12) -> list[list[Point]]:
    """Slanted teeth round the sun, like those of a milling cutter seen from below."""
    step = 2 * math.pi / count
    return [
        [
            turned(83, k * step - 0.32 * step),
            turned(128, k * step + 0.02 * step),
            turned(121, k * step + 0.32 * step),
            turned(83, k * step + 0.27 * step),
        ]
        for k in range(count)
    ]


def lens_outline(points: int = 200) -> list[Point]:
    """Two circular arcs that meet in a point on either side."""
    radius = (LENS_HALF_WIDTH**2 + LENS_HALF_DEPTH**2) / (2 * LENS_HALF_DEPTH)
    reach = math.asin(LENS_HALF_WIDTH / radius)
    angles = [reach * (2 * k / points - 1) for k in range(points + 1)]
    depth = [(radius * math.sin(a), radius * math.cos(a) - radius + LENS_HALF_DEPTH) for a in angles]
    return [(CENTRE_X + x, LENS_Y - d) for x, d in depth] + [(CENTRE_X + x, LENS_Y + d) for x, d in depth[::-1]]


def beams(count: int = 5) -> list[list[Point]]:
    """Wedges of light from just below the lens to a little before the focus."""
    start_y, end_y = 380.0, 460.0
    shrink = (FOCUS_Y - end_y) / (FOCUS_Y - start_y)
    wedges = []
    for k in range(count):
        middle, half = (k - (count - 1) / 2) * 80.0, 20.0
        wide, narrow = (middle - half, middle + half), ((middle + half) * shrink, (middle - half) * shrink)
        wedges.append([(CENTRE_X + x, start_y) for x in wide] + [(CENTRE_X + x, end_y) for x in narrow])
    return wedges


def draw_logo() -> Image.Image:
    """The mark, 512 x 512, 8 bit grey."""
    image = Image.new("L", (SIDE * FINE, SIDE * FINE), 0)
    pen = ImageDraw.Draw(image)
    for outline in (*sun_teeth(), lens_outline(), *beams()):
        pen.polygon([(FINE * x, FINE * y) for x, y in outline], fill=255)
    for y, radius, level in ((SUN_Y, 70, 255), (SUN_Y, 46, 0), (SUN_Y, 33, 255), (FOCUS_Y, 14, 255)):
        box = [FINE * (CENTRE_X - radius), FINE * (y - radius), FINE * (CENTRE_X + radius), FINE * (y + radius)]
        pen.ellipse(box, fill=level)
    return image.reduce(FINE)


if __name__ == "__main__":
    draw_logo().save(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("logo.png"), optimize=True)
