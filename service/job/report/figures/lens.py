"""PNG figures of the lens itself: its heights, its relief in raking light, and the paper's flow step by step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from service.job.report.figures.base import COLOURS, Array, new_figure, panel_height, png_bytes, round_up

_LINES_SHOWN = 48
_CONTOURED = 400  # vertices along a side for contour lines: about a pixel and a half each
_LEAST_SCALE_MM = 1e-3


class FlowStep(Protocol):
    """The paper's flow after some steps, in the work frame (row 0 at the lowest y); optics.paper.flow makes them.

    lens_mm (ny, nx, 2)  : where on the lens the light of each screen vertex comes from
    difference (ny, nx)  : D = L J - C at the screen vertices, in units of the mean of the target
    """

    @property
    def step(self) -> int: ...
    @property
    def lens_mm(self) -> Array: ...
    @property
    def difference(self) -> Array: ...


def heightfield_png(
    x_mm: Array, y_mm: Array, z_mm: Array, *, outline_mm: Sequence[Sequence[float]] | None = None
) -> bytes:
    """Draw heights (ny, nx) with contour lines, and the same surface in raking light; both from above, on the mill.

    outline_mm : corners of the lens within its aperture; the rest is shown paler
    """
    figure = new_figure(12.6, 0.7 + panel_height(4.9, float(np.ptp(y_mm)), float(np.ptp(x_mm))))
    heights, relief = figure.subplots(1, 2)
    extent = (float(x_mm[0]), float(x_mm[-1]), float(y_mm[0]), float(y_mm[-1]))
    depth_mm, middle_mm = float(np.ptp(z_mm)), float(z_mm.max() + z_mm.min()) / 2
    half_mm = max(depth_mm, _LEAST_SCALE_MM) / 2  # do not colour the rounding errors of a flat lens
    image = heights.imshow(
        z_mm, extent=extent, origin="lower", cmap=COLOURS, vmin=middle_mm - half_mm, vmax=middle_mm + half_mm
    )
    step_mm = round_up(depth_mm / 25)
    title = f"Height z: relief {depth_mm:.2f} mm"
    if depth_mm > 1e-6:
        levels = np.arange(np.ceil(z_mm.min() / step_mm), np.floor(z_mm.max() / step_mm) + 1) * step_mm
        nth = slice(None, None, 1 + max(z_mm.shape) // _CONTOURED)
        heights.contour(
            x_mm[nth], y_mm[nth], z_mm[nth, nth],
            levels=levels, colors="white", linewidths=0.5, linestyles="solid", alpha=0.8,
        )  # fmt: skip
        title += f", a line every {step_mm:g} mm"
    bar = figure.colorbar(image, ax=heights, fraction=0.046, pad=0.03)
    bar.set_label("z [mm], 0 = top of the stock")
    heights.set_title(title, fontsize=11)
    relief.imshow(shade_by_raking_light(x_mm, y_mm, z_mm), extent=extent, origin="lower", cmap="gray", vmin=0, vmax=1)
    relief.set_title("Relief, lit from the upper left", fontsize=11)
    for axes in (heights, relief):
        axes.set_xlabel("x [mm]")
        axes.set_ylabel("y [mm]")
        if outline_mm is not None:
            _draw_outline(axes, outline_mm, extent)
    return png_bytes(figure)


def _draw_outline(axes: Axes, outline_mm: Sequence[Sequence[float]], extent: tuple[float, float, float, float]) -> None:
    """Draw the rim of the lens, and a veil over the rest of the aperture."""
    left, right, low, high = extent
    frame = [(left, low), (right, low), (right, high), (left, high), (left, low)]
    rim = [(float(x), float(y)) for x, y in outline_mm]
    hole = [*rim, rim[0]][::-1]  # in the opposite direction to the frame, so that the veil leaves it out
    codes = [code for ring in (frame, hole) for code in (Path.MOVETO, *[Path.LINETO] * (len(ring) - 2), Path.CLOSEPOLY)]
    veil = PathPatch(Path([*frame, *hole], codes), facecolor="white", alpha=0.75, edgecolor="none")
    axes.add_patch(veil)
    axes.plot(*zip(*hole, strict=True), color="black", linewidth=1.2)


def shade_by_raking_light(x_mm: Array, y_mm: Array, z_mm: Array) -> Array:
    """Return brightness 0 to 1 (ny, nx) of the surface z_mm (ny, nx) lit from the upper left, 40 degrees above the
    plane.
    """
    light = LightSource(azdeg=315, altdeg=40)
    dy_mm = float(y_mm[1] - y_mm[0])
    # LightSource takes row 0 as the top; ours has the lowest y
    return np.asarray(light.hillshade(z_mm, dx=float(x_mm[1] - x_mm[0]), dy=-dy_mm), dtype=np.float64)


def flow_png(steps: Sequence[FlowStep], *, viewed_from: str) -> bytes:
    """Draw the paper's Fig. 6: the mapping's isoparametric lines above, the difference D below, one column per step.

    The panels are turned as the viewer sees the screen: for viewed_from "lens" x runs to the left.
    """
    figure = new_figure(2.75 * len(steps) + 0.6, 0.7 + 2 * panel_height(2.65, *steps[0].difference.shape))
    panels = figure.subplots(2, len(steps), squeeze=False)
    for (above, below), flow in zip(panels.T, steps, strict=True):
        above.set_title(f"after {flow.step} step{'s' * (flow.step != 1)}", fontsize=11)
        _draw_mapping(above, flow.lens_mm)
        extent = (-0.5, flow.difference.shape[1] - 0.5, -0.5, flow.difference.shape[0] - 0.5)
        image = below.imshow(100 * flow.difference, origin="lower", extent=extent, cmap="RdBu_r", vmin=-100, vmax=100)
        rms, largest = np.sqrt(np.mean(flow.difference**2)), np.abs(flow.difference).max()
        below.set_xlabel(f"rms {100 * rms:.1f} %, largest {100 * largest:.0f} %", fontsize=9)
        for axes in (above, below):
            axes.set(xticks=[], yticks=[])
            if viewed_from == "lens":
                axes.invert_xaxis()
    bar = figure.colorbar(image, ax=panels[1, :], fraction=0.012, pad=0.01, extend="both")
    bar.set_label("D, % of the mean (red: too much)")
    panels[0, 0].set_ylabel("lines of equal u, v on the lens", fontsize=9)
    panels[1, 0].set_ylabel("difference D on the screen", fontsize=9)
    return png_bytes(figure)


def _draw_mapping(axes: Axes, lens_mm: Array) -> None:
    """Draw about 48 moved grid lines in each direction, the first and the last among them."""
    ny, nx = lens_mm.shape[:2]
    rows = np.unique(np.linspace(0, ny - 1, min(ny, _LINES_SHOWN + 1)).astype(int))
    columns = np.unique(np.linspace(0, nx - 1, min(nx, _LINES_SHOWN + 1)).astype(int))
    lines = [*lens_mm[rows], *lens_mm.transpose(1, 0, 2)[columns]]
    axes.add_collection(LineCollection(lines, linewidths=0.35, colors="black"))
    (left, bottom), (right, top) = lens_mm.min(axis=(0, 1)), lens_mm.max(axis=(0, 1))
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
