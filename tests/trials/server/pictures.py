"""Small pictures for jobs, each of its own."""

from __future__ import annotations

import io
from functools import cache

import numpy as np
from PIL import Image


@cache
def picture(number: int, pixels: int = 64) -> bytes:
    """A smooth PNG; the same number is the same file."""
    y, x = np.mgrid[0:pixels, 0:pixels] / (pixels - 1)
    light = 120 + 60 * np.sin((3 + number) * x + y) * y + 30 * np.cos(5 * y + number)
    out = io.BytesIO()
    Image.fromarray(np.clip(np.rint(light), 0, 255).astype(np.uint8)).save(out, "PNG")
    return out.getvalue()
