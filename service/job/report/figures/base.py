"""The common base of a report's figures: a figure of matplotlib, its size, and its PNG."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from service.job.picture.light_png import COMPRESS_LEVEL

Array = NDArray[np.float64]

_DPI = 150
COLOURS = "viridis"  # of heights and of times


def new_figure(width_in: float, height_in: float) -> Figure:
    """Make a figure of its own, outside pyplot's global state, so that threads do not share anything."""
    figure = Figure(figsize=(width_in, height_in), dpi=_DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def panel_height(width_in: float, height: float, width: float) -> float:
    """Return inches for a panel width_in wide that shows something of height x width; long strips keep white around
    them.
    """
    return width_in * min(max(height / width, 0.25), 2.5)


def png_bytes(figure: Figure) -> bytes:
    """Draw once: `savefig` draws all of it a first time only to lay it out."""
    canvas: Any = figure.canvas
    canvas.draw()
    buffer = io.BytesIO()
    opaque = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    opaque.save(buffer, format="PNG", dpi=(_DPI, _DPI), compress_level=COMPRESS_LEVEL)
    return buffer.getvalue()


def round_up(value: float) -> float:
    """Return the next of 1, 2, 5, 10, ... at or above value; 1 for zero."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9)))
