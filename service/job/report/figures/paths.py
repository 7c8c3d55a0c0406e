"""toolpath.png: each pass seen from above, the whole part, and beside or below it single tracks.

For a contour pass, the picture of the whole part shows pieces of the path coloured by height: a piece along a contour
line has one colour. Its single tracks are coloured by the order in which they are cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle

from service.job.report.figures.base import COLOURS, Array, new_figure, panel_height, png_bytes
from service.job.report.figures.path_sample import ContourSample, PathSample

__all__ = ["PathSample", "toolpath_png"]

_CMAP = ListedColormap(colormaps[COLOURS](np.linspace(0.0, 0.87, 256)))  # its yellow end is invisible on white
_ORDER = ListedColormap(colormaps["turbo"](np.linspace(0.03, 0.97, 256)))
_RAPID = "crimson"
_SIDE_BY_SIDE = 3  # passes
_DOTS_UP_TO = 15_000  # vertices; more of them make a solid patch


@dataclass(frozen=True, slots=True, kw_only=True)
class _Part:
    """The aperture with its lower left corner at (0, 0), the lens in it, the block around it."""

    width_mm: float
    height_mm: float
    margin_mm: float
    outline_mm: Sequence[Sequence[float]]


def toolpath_png(
    samples: Sequence[PathSample],
    *,
    width_mm: float,
    height_mm: float,
    margin_mm: float = 0.0,
    outline_mm: Sequence[Sequence[float]] | None = None,
) -> bytes:
    """Draw two panels for each pass, side by side; of three passes or more one above the other, so that the picture
    fits half a page. Colour is the height of the tool tip, the same in all panels.

    outline_mm : corners of a lens that does not fill its aperture
    """
    part = _Part(width_mm=width_mm, height_mm=height_mm, margin_mm=margin_mm, outline_mm=outline_mm or ())
    count = max(1, len(samples))
    block_in = panel_height(5.1, height_mm + 2 * margin_mm, width_mm + 2 * margin_mm)
    row_in = 1.0 + max(block_in, 3.0)  # the square of single tracks needs some height
    if count < _SIDE_BY_SIDE:
        figure = new_figure(12.6, row_in * count + 0.3)
        panels = figure.subplots(count, 2, squeeze=False)
    else:
        figure = new_figure(5.9 * count + 0.8, 2 * row_in + 0.3)
        panels = figure.subplots(2, count, squeeze=False).T
    depths = np.concatenate([sample.bounds_mm()[:, 2] for sample in samples]) if samples else np.zeros(1)
    deepest = float(np.nanmin(depths)) if np.isfinite(depths).any() else 0.0
    norm = Normalize(vmin=min(deepest, -1e-3), vmax=0.0)
    for (whole, window), sample in zip(panels, samples, strict=False):
        _draw_whole_part(whole, sample, norm, part)
        if isinstance(sample, ContourSample):
            _draw_contour_window(window, sample, part)
        else:
            _draw_window(window, sample, norm, part)
    mappable = LineCollection([], cmap=_CMAP, norm=norm)
    bar = figure.colorbar(mappable, ax=panels, fraction=0.02, pad=0.01, aspect=40)
    bar.set_label("height of the tool tip z [mm], 0 = top of the stock")
    marks = [
        Line2D([], [], color=_RAPID, linestyle="--", linewidth=1, label="rapid move"),
        Line2D([], [], color=_RAPID, marker="v", linestyle="none", markersize=6, label="cutting begins"),
        Line2D([], [], color="black", linewidth=1.2, label="lens" if part.outline_mm else "lens aperture"),
        Line2D([], [], color="0.55", linewidth=1.2, label="block"),
        Line2D([], [], color="black", marker="+", markersize=10, linestyle="none", label="work zero"),
    ]
    if part.outline_mm:
        marks.insert(3, Line2D([], [], color="black", linestyle=":", linewidth=1.2, label="aperture"))
    if any(isinstance(sample, ContourSample) for sample in samples):
        end = Line2D([], [], color=_RAPID, marker="s", linestyle="none", markersize=6, label="the contour path ends")
        marks.insert(2, end)
    figure.legend(handles=marks, loc="outside lower center", ncols=len(marks), frameon=False, fontsize=9)
    return png_bytes(figure)


def _draw_whole_part(axes: Axes, sample: PathSample, norm: Normalize, part: _Part) -> None:
    is_contour = isinstance(sample, ContourSample)
    tracks = sample.tracks_mm() if isinstance(sample, ContourSample) else sample.cuts_mm()
    _draw_moves(axes, tracks, sample.rapids_mm(), norm, width=1.1 if is_contour else 0.9)
    _draw_block(axes, part)
    _draw_entries(axes, sample)
    window = sample.window
    side = max(window.x1_mm - window.x0_mm, 0.02 * part.width_mm)
    middle = 0.5 * (window.x0_mm + window.x1_mm), 0.5 * (window.y0_mm + window.y1_mm)
    corner = middle[0] - side / 2, middle[1] - side / 2
    axes.add_patch(Rectangle(corner, side, side, fill=False, edgecolor="black", linewidth=1.4, zorder=6))
    low, high = sample.bounds_mm()[:, :2] if sample.moves > sample.rapids else np.zeros((2, 2))
    edge = 0.03 * max(part.width_mm, part.height_mm)
    left, right = min(-part.margin_mm, low[0], corner[0]), max(part.width_mm + part.margin_mm, high[0])
    axes.set_xlim(left - edge, right + edge)
    axes.set_ylim(min(-part.margin_mm, low[1]) - edge, max(part.height_mm + part.margin_mm, high[1]) + edge)
    axes.set_title(f"{sample.label}: the whole part", fontsize=11)
    shown = f"of rows {sample.pitch_mm:g} mm apart one every {sample.row_distance_mm:.3g} mm is drawn"
    if isinstance(sample, ContourSample):
        shown = (
            f"one path of {sample.length_mm / 1000:,.1f} m along the contour lines,\n"
            f"tracks {sample.pitch_mm:g} mm apart; pieces about {sample.row_distance_mm:.2g} mm apart are drawn"
        )
        _draw_ends(axes, sample)
    elif sample.row_distance_mm <= sample.pitch_mm:
        shown = f"rows {sample.pitch_mm:g} mm apart, all drawn"
    _label_axes(axes, f"x [mm]\n{sample.moves:,} moves, {sample.rapids:,} of them rapid; {shown}")


def _draw_window(axes: Axes, sample: PathSample, norm: Normalize, part: _Part) -> None:
    cuts, jumps = sample.zoom_mm()
    _draw_moves(axes, cuts, jumps, norm, width=1.1)
    window = sample.window
    drawn = "every move; no vertex drawn"
    if 0 < len(cuts) <= _DOTS_UP_TO:
        axes.plot(cuts[:, 1, 0], cuts[:, 1, 1], ".", color="black", markersize=2.2, zorder=4)
        drawn = "every move; a dot at each vertex"
    elif not len(cuts):
        axes.text(0.5, 0.5, "no moves here", transform=axes.transAxes, ha="center", color="0.4")
        drawn = "no moves"
    _draw_block(axes, part)
    _draw_entries(axes, sample)
    axes.set(xlim=(window.x0_mm, window.x1_mm), ylim=(window.y0_mm, window.y1_mm))
    axes.set_title(f"The small square, {window.x1_mm - window.x0_mm:.2g} mm wide", fontsize=11)
    _label_axes(axes, f"x [mm]\n{drawn}; rows {sample.pitch_mm:g} mm apart")


def _draw_contour_window(axes: Axes, sample: ContourSample, part: _Part) -> None:
    """Draw every move, coloured by when it is cut."""
    moves, along = sample.window_tracks()
    flat: Any = moves[:, :, :2]
    lines = LineCollection(flat, cmap=_ORDER, norm=Normalize(0.0, 100.0), linewidths=1.2, capstyle="round")
    lines.set_array(100 * along)
    axes.add_collection(lines)
    bar = axes.inset_axes((1.02, 0.0, 0.03, 1.0))
    axes.figure.colorbar(lines, cax=bar).set_label("cut at % of the path", fontsize=8)
    bar.tick_params(labelsize=7)
    _draw_block(axes, part)
    _draw_ends(axes, sample)
    window = sample.window
    axes.set(xlim=(window.x0_mm, window.x1_mm), ylim=(window.y0_mm, window.y1_mm))
    axes.set_title(f"The small square, {window.x1_mm - window.x0_mm:.2g} mm wide", fontsize=11)
    _label_axes(axes, f"x [mm]\nevery move; tracks at most {sample.pitch_mm:g} mm apart")


def _draw_ends(axes: Axes, sample: ContourSample) -> None:
    (x0, y0, _), (x1, y1, _) = sample.ends_mm()
    axes.plot(x0, y0, "v", color=_RAPID, markersize=9, markeredgecolor="white", zorder=9)
    axes.plot(x1, y1, "s", color=_RAPID, markersize=7, markeredgecolor="white", zorder=9)


def _draw_moves(axes: Axes, cuts: Array, jumps: Array, norm: Normalize, *, width: float) -> None:
    flat: list[Any] = [cuts[:, :, :2], jumps[:, :, :2]]  # the stubs only allow sequences; an array is drawn faster
    lines = LineCollection(flat[0], cmap=_CMAP, norm=norm, linewidths=width, capstyle="round")
    lines.set_array(cuts[:, :, 2].mean(axis=1))
    axes.add_collection(lines)
    axes.add_collection(LineCollection(flat[1], colors=_RAPID, linewidths=0.8, linestyles="--", zorder=5))


def _draw_entries(axes: Axes, sample: PathSample) -> None:
    points = sample.entry_points_mm()
    size = 6 if len(points) < 200 else 2.5
    axes.plot(points[:, 0], points[:, 1], "v", color=_RAPID, markersize=size, markeredgewidth=0, zorder=7)


def _draw_block(axes: Axes, part: _Part) -> None:
    aperture = Rectangle((0, 0), part.width_mm, part.height_mm, fill=False, edgecolor="black", linewidth=1.2, zorder=5)
    axes.add_patch(aperture)
    if part.outline_mm:
        aperture.set_linestyle(":")
        axes.add_patch(Polygon(part.outline_mm, fill=False, edgecolor="black", linewidth=1.2, zorder=5))
    if part.margin_mm > 0:
        wide, high = part.width_mm + 2 * part.margin_mm, part.height_mm + 2 * part.margin_mm
        corner = -part.margin_mm, -part.margin_mm
        axes.add_patch(Rectangle(corner, wide, high, fill=False, edgecolor="0.55", linewidth=1.2, zorder=5))
    axes.plot(0, 0, "+", color="black", markersize=12, markeredgewidth=1.5, zorder=8)


def _label_axes(axes: Axes, below: str) -> None:
    axes.set_aspect("equal")
    axes.set_xlabel(below, fontsize=9)
    axes.set_ylabel("y [mm]", fontsize=9)
    axes.tick_params(labelsize=8)
