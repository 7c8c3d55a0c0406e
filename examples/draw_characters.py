"""Draws examples/characters.png: four Chinese characters.   python examples/draw_characters.py [FILE]

Light, sun, moon, mountain, as brush strokes along polylines of our own: no font is involved.
"""

import sys
from pathlib import Path

from PIL import Image, ImageDraw

SIDE, FINE = 512, 8
GROUND, INK, WIDTH = 105, 255, 19  # the ground is dim, not black: a continuous surface cannot make black
Stroke = list[tuple[float, float]]
CHARACTERS: dict[str, list[Stroke]] = {  # each in a square of 100 x 100, y downward
    "光": [
        [(50, 6), (50, 44)],
        [(24, 14), (35, 36)],
        [(76, 14), (65, 36)],
        [(8, 46), (92, 46)],
        [(38, 46), (36, 66), (26, 82), (10, 94)],
        [(62, 46), (62, 84), (68, 91), (88, 91), (91, 76)],
    ],
    "日": [[(24, 8), (24, 94)], [(24, 10), (76, 10), (76, 94)], [(24, 50), (76, 50)], [(24, 90), (76, 90)]],
    "月": [
        [(28, 8), (28, 60), (24, 78), (12, 94)],
        [(28, 10), (78, 10), (78, 90), (64, 90)],
        [(28, 36), (78, 36)],
        [(28, 62), (78, 62)],
    ],
    "山": [[(50, 8), (50, 88)], [(12, 38), (12, 90), (88, 90)], [(88, 38), (88, 94)]],
}


def draw_characters() -> Image.Image:
    """The picture, 512 x 512, 8 bit grey."""
    image = Image.new("L", (SIDE * FINE, SIDE * FINE), GROUND)
    pen = ImageDraw.Draw(image)
    for place, strokes in enumerate(CHARACTERS.values()):
        left, top = 36 + 240 * (place % 2), 36 + 240 * (place // 2)
        for stroke in strokes:
            points = [(FINE * (left + 2.0 * x), FINE * (top + 2.0 * y)) for x, y in stroke]
            pen.line(points, fill=INK, width=WIDTH * FINE, joint="curve")
            for x, y in points:
                half = WIDTH * FINE / 2
                pen.ellipse([x - half, y - half, x + half, y + half], fill=INK)
    return image.reduce(FINE)


if __name__ == "__main__":
    draw_characters().save(
        sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("characters.png"), optimize=True
    )
