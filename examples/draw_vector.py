"""Draws examples/vector.png: flat tones, thin dark lines, crisp corners.   python examples/draw_vector.py [FILE]

A boat on the sea before mountains and a sun: polygons of a few grey levels, none of them black.
"""

import sys
from pathlib import Path

from PIL import Image, ImageDraw

SIDE, FINE = 512, 8  # drawn FINE times larger, then averaged: edges end up one pixel wide
SKY, SUN, FAR, NEAR, SEA, SAIL, HULL, LINE = 150, 255, 120, 95, 130, 245, 200, 60
SHAPES = (
    ((SKY), [(0, 0), (512, 0), (512, 330), (0, 330)]),
    ((FAR), [(0, 330), (70, 215), (120, 260), (215, 150), (330, 330)]),
    ((NEAR), [(230, 330), (330, 230), (380, 275), (450, 185), (512, 250), (512, 330)]),
    ((SEA), [(0, 330), (512, 330), (512, 512), (0, 512)]),
    ((HULL), [(130, 395), (390, 395), (345, 450), (165, 450)]),
    ((SAIL), [(250, 120), (250, 380), (130, 380)]),
    ((SAIL), [(268, 160), (268, 380), (380, 380)]),
)
LINES = ([(259, 100), (259, 395)], [(40, 480), (470, 480)], [(90, 350), (120, 350)], [(400, 365), (480, 365)])


def draw_vector() -> Image.Image:
    """The picture, 512 x 512, 8 bit grey."""
    image = Image.new("L", (SIDE * FINE, SIDE * FINE), SKY)
    pen = ImageDraw.Draw(image)
    for level, corners in SHAPES:
        pen.polygon([(FINE * x, FINE * y) for x, y in corners], fill=level)
        if level in (SAIL, HULL):
            pen.line([(FINE * x, FINE * y) for x, y in [*corners, corners[0]]], fill=LINE, width=5 * FINE)
    pen.ellipse([FINE * v for v in (390, 40, 470, 120)], fill=SUN)
    for line in LINES:
        pen.line([(FINE * x, FINE * y) for x, y in line], fill=LINE, width=5 * FINE)
    return image.reduce(FINE)


if __name__ == "__main__":
    draw_vector().save(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("vector.png"), optimize=True)
