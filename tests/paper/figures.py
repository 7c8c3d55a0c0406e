"""The pictures of docs/paper.md: rows of panels, drawn with matplotlib's Agg, stored as JPEG."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource
from matplotlib.figure import Figure

from optics.heightfield import Heightfield
from tests.paper.cases import as_picture

Draw = Callable[[Axes], None]
_DPI = 120


def panels(path: Path, rows: Sequence[Sequence[tuple[str, Draw]]], *, side: float = 2.6) -> None:
    """Each panel a title and a function that draws it."""
    figure = Figure(figsize=(side * len(rows[0]), (side + 0.3) * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), len(rows[0]), squeeze=False)
    for line, cells in zip(axes, rows, strict=True):
        for place, (title, draw) in zip(line, cells, strict=True):
            draw(place)
            place.set(xticks=[], yticks=[])
            place.set_title(title, fontsize=8)
    figure.set_dpi(_DPI)
    FigureCanvasAgg(figure).print_jpg(path, pil_kwargs={"quality": 82, "optimize": True})


Part = tuple[float, float, float, float]
WHOLE: Part = (0.0, 1.0, 0.0, 1.0)


def picture(light: np.ndarray, peak: float, *, part: Part = WHOLE) -> Draw:
    """part: top, bottom, left and right as shares of the picture's sides."""
    grey = as_picture(light, peak)
    top, bottom, left, right = (round(share * side) for share, side in zip(part, np.repeat(grey.shape, 2), strict=True))
    return lambda axes: axes.imshow(grey[top:bottom, left:right], cmap="gray", vmin=0, vmax=255) and None


def difference(values: np.ndarray) -> Draw:
    """D in percent of the mean: red where there is too much."""
    return lambda axes: axes.imshow(100 * values, origin="lower", cmap="RdBu_r", vmin=-100, vmax=100) and None


def field(values: np.ndarray) -> Draw:
    """Blue where lowest, red where highest."""
    return lambda axes: axes.imshow(values, origin="lower", cmap="RdBu_r") and None


def arrows(size: np.ndarray, vectors: np.ndarray, count: int = 20) -> Draw:
    """Vectors (ny, nx, 2) at count x count places over their length (ny, nx)."""

    def draw(axes: Axes) -> None:
        axes.imshow(size, origin="lower", cmap="Greys", vmax=1.6 * size.max())
        j, i = (((np.arange(count) + 0.5) * side / count).astype(int) for side in size.shape)
        axes.quiver(*np.meshgrid(i, j), *np.moveaxis(vectors[np.ix_(j, i)], -1, 0), width=0.004, color="tab:red")

    return draw


def lines(lens_mm: np.ndarray, count: int = 48) -> Draw:
    """Lines of constant u and of constant v on the lens."""

    def draw(axes: Axes) -> None:
        ny, nx = lens_mm.shape[:2]
        along = [lens_mm[j] for j in np.linspace(0, ny - 1, count + 1).round().astype(int)]
        across = [lens_mm[:, i] for i in np.linspace(0, nx - 1, count + 1).round().astype(int)]
        axes.add_collection(LineCollection([*along, *across], linewidths=0.3, colors="black"))
        axes.set(xlim=(0, lens_mm[..., 0].max()), ylim=(0, lens_mm[..., 1].max()), aspect="equal")

    return draw


def relief(lens: Heightfield) -> Draw:
    """The surface in raking light from the upper left."""
    shade = LightSource(azdeg=315, altdeg=40).hillshade(lens.z_mm, dx=lens.dx_mm, dy=-lens.dy_mm)
    return lambda axes: axes.imshow(shade, origin="lower", cmap="gray", vmin=0, vmax=1) and None
