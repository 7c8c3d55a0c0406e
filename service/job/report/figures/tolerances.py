"""PNG figure of tolerances: what becomes of the picture when the set-up is not exact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes

from optics.tolerance import FOCUS_LOSS_DB, Tolerances
from service.job.report.figures.base import Array, new_figure, panel_height, png_bytes
from service.job.report.figures.wall import show_light

_LINE: dict[str, Any] = {"marker": "o", "markersize": 4, "linewidth": 1.2, "color": "#1d5c8c"}
_SHIFT: dict[str, Any] = {"marker": "s", "markersize": 3.5, "linewidth": 1.0, "color": "#c77700", "linestyle": "--"}
_SMALL = 8.5
_HEADROOM_DB = 3.0
_SEEN_DEG = "diameter seen from the lens [degrees]; the sun has 0.53"


def tolerances_png(found: Tolerances, pictures: Sequence[tuple[str, Array]], *, white: float) -> bytes:
    """Draw curves above, and below some of the pictures that they stand for.

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
