"""Figures of the light on the wall as PNG: caustic beside target, as milled, out of focus, and with an inexact set-up;
exposed as in `light_png`.

A picture here is (ny, nx) linear irradiance as the viewer sees it, row 0 at the top.
Every function returns the bytes of a PNG and writes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from scipy.ndimage import uniform_filter

from optics.tolerance import FOCUS_LOSS_DB, Tolerances
from service.job.picture.light_png import srgb_levels
from service.job.report.figures.base import Array, new_figure, panel_height, png_bytes, round_up

_LEAST_SCALE_PERCENT = 0.1
_PART = 4  # a quarter of each side is shown enlarged
_QUIET: dict[str, Any] = {"fontsize": 9, "color": "0.35"}
_LINE: dict[str, Any] = {"marker": "o", "markersize": 4, "linewidth": 1.2, "color": "#1d5c8c"}
_SHIFT: dict[str, Any] = {"marker": "s", "markersize": 3.5, "linewidth": 1.0, "color": "#c77700", "linestyle": "--"}
_SMALL = 8.5
_HEADROOM_DB = 3.0
_SEEN_DEG = "diameter seen from the lens [degrees]; the sun has 0.53"


def show_light(axes: Axes, picture: Array, white: float, **look: Any) -> None:
    """Draw a picture (ny, nx) into axes; look: of `imshow`."""
    axes.imshow(srgb_levels(picture, white=white), cmap="gray", vmin=0, vmax=255, **look)


def comparison_png(target: Array, caustic: Array, *, title: str = "Simulated caustic") -> bytes:
    """Draw target, caustic and their difference: caustic - target in percent of white, red where too bright."""
    white = float(target.max())
    difference = 100.0 * (caustic - target) / white
    rms = float(np.sqrt(np.mean(difference**2)))
    limit = round_up(max(float(np.percentile(np.abs(difference), 99.5)), _LEAST_SCALE_PERCENT))
    figure = new_figure(12.9, 0.55 + panel_height(4.0, *target.shape))
    panels = figure.subplots(1, 3)
    for axes, words, picture in zip(panels, ("Target", title), (target, caustic), strict=False):
        _show_picture(axes, words, picture, white)
    axes = _without_ticks(panels[2], "Difference: caustic \N{MINUS SIGN} target")
    image = axes.imshow(difference, cmap="RdBu_r", vmin=-limit, vmax=limit)
    bar = figure.colorbar(image, ax=panels, extend="both", fraction=0.03, pad=0.01, shrink=0.86)
    bar.set_label("% of white (red: too bright)")
    axes.set_xlabel(f"rms {rms:.2g} % of white; colours end at ±{limit:g} %", **_QUIET)
    return png_bytes(figure)


def preparation_png(given: Array, prepared: Array, *, detail_mm: float) -> bytes:
    """Draw the picture as given and as prepared for the lens, both with the same amount of light."""
    white = float(max(np.quantile(given, 0.999), np.quantile(prepared, 0.999)))
    figure = new_figure(9.0, 0.5 + panel_height(4.4, *given.shape))
    panels = figure.subplots(1, 2)
    titles = ("The picture as given", f"Prepared for details from {detail_mm:.2g} mm")
    for axes, title, picture in zip(panels, titles, (given, prepared), strict=True):
        _show_picture(axes, title, picture, white)
    return png_bytes(figure)


def through_focus_png(pictures: Sequence[tuple[float, Array]], *, throw_mm: float, white: float) -> bytes:
    """Draw the caustic on screens at several distances; `pictures` holds (distance / throw, picture) in order."""
    shape = pictures[0][1].shape
    figure = new_figure(3.2 * len(pictures) + 0.1, 0.6 + panel_height(3.15, *shape))
    panels = figure.subplots(1, len(pictures), squeeze=False)[0]
    for axes, (factor, picture) in zip(panels, pictures, strict=True):
        focus = ", in focus" if abs(factor - 1.0) < 1e-9 else ""
        _show_picture(axes, f"{factor:.1f} × throw{focus}", picture, white)
        axes.set_xlabel(f"screen {factor * throw_mm:g} mm from the stock top", **_QUIET)
    return png_bytes(figure)


def as_milled_png(target: Array, designed: Array, milled: Array, *, figures: Mapping[str, Any]) -> bytes:
    """Draw pictures (ny, nx) as the viewer sees them, row 0 on top; figures: report `as_milled`."""
    white = float(target.max())
    captions = (
        "Target",
        f"As designed, {figures['psnr_db_designed']:.1f} dB",
        f"As milled, {figures['psnr_db']:.1f} dB, blur {figures['blur_px']:.1f} px rms",
    )
    rows, columns = busiest_part(target)
    figure = new_figure(12.6, 0.5 + 2 * panel_height(4.15, *target.shape))
    panels = figure.subplots(2, 3)
    for k, (caption, picture) in enumerate(zip(captions, (target, designed, milled), strict=True)):
        for axes, shown in ((panels[0, k], picture), (panels[1, k], picture[rows, columns])):
            show_light(axes, shown, white, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        panels[0, k].set_title(caption, fontsize=10)
    return png_bytes(figure)


def busiest_part(picture: Array) -> tuple[slice, slice]:
    """Return the quarter of each side in which the picture changes most from pixel to pixel."""
    ny, nx = picture.shape
    high, wide = max(ny // _PART, min(8, ny)), max(nx // _PART, min(8, nx))
    change = np.hypot(*np.gradient(picture))
    mean = uniform_filter(change, (high, wide), mode="constant")[high // 2 : ny - high // 2, wide // 2 : nx - wide // 2]
    if mean.size == 0:
        return slice(0, ny), slice(0, nx)
    j, i = divmod(int(mean.argmax()), mean.shape[1])
    return slice(j, j + high), slice(i, i + wide)


def _without_ticks(axes: Axes, title: str) -> Axes:
    axes.set_title(title, fontsize=11)
    axes.set(xticks=[], yticks=[])
    return axes


def _show_picture(axes: Axes, title: str, picture: Array, white: float) -> None:
    show_light(_without_ticks(axes, title), picture, white)


def tolerances_png(found: Tolerances, pictures: Sequence[tuple[str, Array]], *, white: float) -> bytes:
    """Draw the curves above, and some of the corresponding pictures below.

    pictures : (caption, picture as the viewer sees it, row 0 on top); all at one exposure, `white` is 255
    """
    width_in = 12.6
    below_in = panel_height(width_in / len(pictures) - 0.1, *pictures[0][1].shape)
    figure = new_figure(width_in, 3.6 + 0.5 + below_in)
    parts: Any = figure.subfigures(2, 1, height_ratios=[3.6, 0.5 + below_in])
    curves, shown = parts
    focus, tilt, blur = curves.subplots(1, 3, sharey=True)
    _draw_focus(focus, found)
    _draw_tilt(tilt, found)
    _draw_blur(blur, found)
    scores = [p.psnr_db for points in (found.focus, found.tilts, found.sources) for p in points]
    focus.set_ylim(min(*scores, found.psnr_db - FOCUS_LOSS_DB) - _HEADROOM_DB, max(scores) + _HEADROOM_DB)
    focus.set_ylabel("PSNR [dB]", fontsize=_SMALL)
    for axes, (caption, picture) in zip(shown.subplots(1, len(pictures), squeeze=False)[0], pictures, strict=True):
        show_light(axes, picture, white)
        axes.set(xticks=[], yticks=[])
        axes.set_title(caption, fontsize=_SMALL)
    return png_bytes(figure)


def _draw_focus(axes: Axes, found: Tolerances) -> None:
    near, far = found.focus_range_mm
    axes.axvspan(near, far, color="#2e7d46", alpha=0.12, linewidth=0)
    axes.plot([p.offset_mm for p in found.focus], [p.psnr_db for p in found.focus], **_LINE)
    reach = 1.15 * max(abs(point.offset_mm) for point in found.focus)
    axes.set_xlim(-reach, reach)
    _label(axes, "Wall at another distance", "from the throw [mm]: nearer left, farther right")
    axes.text(
        0.5, 0.03, f"{FOCUS_LOSS_DB:g} dB are lost at {near:.2g} and {far:+.2g} mm",
        transform=axes.transAxes, ha="center", fontsize=_SMALL, color="#2e7d46",
    )  # fmt: skip


def _draw_tilt(axes: Axes, found: Tolerances) -> None:
    degrees = [0.0, *(point.tilt_deg for point in found.tilts)]
    axes.plot(degrees, [found.psnr_db, *(point.psnr_db for point in found.tilts)], **_LINE)
    _label(axes, "Light aslant", "degrees from the axis")
    beside = axes.twinx()
    moved = [0.0, *((point.shift_mm[0] ** 2 + point.shift_mm[1] ** 2) ** 0.5 for point in found.tilts)]
    beside.plot(degrees, moved, **_SHIFT)
    beside.set_ylim(0.0, 2.2 * max(moved) or 1.0)
    beside.set_ylabel("picture moves by [mm]", fontsize=_SMALL, color="#c77700")
    beside.tick_params(labelsize=_SMALL, colors="#c77700")


def _draw_blur(axes: Axes, found: Tolerances) -> None:
    axes.plot([point.size_deg for point in found.sources], [point.psnr_db for point in found.sources], **_LINE)
    axes.set_xlim(0.0, 1.25 * found.sources[-1].size_deg)
    _label(axes, "Source of some size" if found.blur_mm == 0 else "Source of another size", _SEEN_DEG)
    for point in found.sources:
        axes.annotate(
            f"{point.diameter_mm:.2g} mm", (point.size_deg, point.psnr_db),
            textcoords="offset points", xytext=(5, 5), fontsize=_SMALL, color="0.35",
        )  # fmt: skip


def _label(axes: Axes, title: str, below: str) -> None:
    axes.set_title(title, fontsize=10.5)
    axes.set_xlabel(below, fontsize=_SMALL)
    axes.tick_params(labelsize=_SMALL)
    axes.grid(alpha=0.25, linewidth=0.6)
