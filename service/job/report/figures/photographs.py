"""Figures of photographs. A measured test piece is shown rectified, with the share of each ripple that the finish left.
A job's wall is shown rectified beside the prediction, with the findings (look.png).
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

from optics.coupon.fit import FinishFit
from optics.finish import Finish
from service.job.report.figures.base import Array, new_figure, panel_height, png_bytes, round_up
from service.job.report.figures.wall import show_light

_INK, _MARK, _QUIET = "0.25", "#b5382a", "0.55"
_COLUMNS = 180
_LINE_IN = 0.19


def coupon_fit_png(seen: Array, fit: FinishFit, *, extent_mm: Sequence[float], notes: Sequence[str] = ()) -> bytes:
    """Draw the rectified photograph (ny, nx), row 0 on top, 1 is straight light; below it H as measured.

    extent_mm : left, right, bottom, top of the photograph on the piece
    """
    tall = panel_height(9.2, *seen.shape)
    figure = new_figure(9.6, tall + 4.4)
    above, below = figure.subplots(2, 1, height_ratios=(tall, 3.6))
    show_light(
        above,
        seen,
        3.0,
        extent=tuple(extent_mm),
        interpolation="antialiased",
    )
    above.set_title("The photograph, laid over the piece (mm)", fontsize=10, color=_INK)
    above.tick_params(labelsize=8, colors=_INK)
    waves = np.array([one.k_rad_per_mm for one in fit.ripples])
    at = np.geomspace(waves.min() / 1.6, waves.max() * 1.6, 200)
    for k0 in fit.k0_range:
        for order in fit.order_range:
            curve = Finish(k0_rad_per_mm=k0, order=order).transfer(at)
            below.plot(2 * np.pi / at, curve, color=_MARK, linewidth=0.6, alpha=0.45)
    found = Finish(k0_rad_per_mm=fit.k0_rad_per_mm, order=fit.order)
    below.plot(2 * np.pi / at, found.transfer(at), color=_MARK, linewidth=1.8)
    below.errorbar(
        [one.period_mm for one in fit.ripples],
        [one.share for one in fit.ripples],
        yerr=[2 * one.error for one in fit.ripples],
        fmt="o", color=_INK, markersize=4.5, capsize=3, linewidth=1,
    )  # fmt: skip
    below.set_xscale("log")
    ticks = [one.period_mm for one in fit.ripples]
    below.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
    below.minorticks_off()
    below.set_ylim(-0.05, 1.15)
    below.set_xlabel("period of the ripple, mm", fontsize=9, color=_INK)
    below.set_ylabel("left of its height, H", fontsize=9, color=_INK)
    below.set_title(
        f"k0 {fit.k0_rad_per_mm:.2f} rad/mm ({fit.k0_range[0]:.2f} to {fit.k0_range[1]:.2f}), order {fit.order:.2f} "
        f"({fit.order_range[0]:.2f} to {fit.order_range[1]:.2f}); bars are two standard errors",
        fontsize=10, color=_INK, loc="left",
    )  # fmt: skip
    below.tick_params(labelsize=8.5, colors=_INK)
    below.grid(alpha=0.25, linewidth=0.6)
    for side in ("top", "right"):
        below.spines[side].set_visible(False)
    if notes:
        below.text(0.99, 0.05, "\n".join(notes), transform=below.transAxes, ha="right", fontsize=8, color=_QUIET)
    return png_bytes(figure)


def look_png(rectified: Array, predicted: Array, sentences: Sequence[str]) -> bytes:
    """Draw look.png: rectified and predicted (ny, nx): irradiance as the viewer sees it, of one scale; NaN: not in the
    photograph.
    """
    lines = [line for text in sentences for line in textwrap.wrap(f"• {text}", _COLUMNS, subsequent_indent="   ")]
    white = float(np.quantile(predicted, 0.998))
    high = panel_height(4.0, *predicted.shape)
    words_in = 0.15 + _LINE_IN * len(lines) if lines else 0.0
    figure = new_figure(12.9, 0.6 + high + words_in)
    panels = figure.subplots(1, 3)
    for axes, title, picture in zip(
        panels, ("Photograph, set straight", "Predicted"), (rectified, predicted), strict=False
    ):
        shown = np.where(np.isfinite(picture), picture, white)
        show_light(axes, shown, white)
        axes.set_title(title, fontsize=11)
    difference = 100.0 * (rectified - predicted) / white
    limit = round_up(max(float(np.nanpercentile(np.abs(difference), 98.0)), 1.0))
    image = panels[2].imshow(difference, cmap="RdBu_r", vmin=-limit, vmax=limit)
    panels[2].set_title("Difference: photograph \N{MINUS SIGN} predicted", fontsize=11)
    panels[2].set_facecolor("0.8")
    for axes in panels:
        axes.set(xticks=[], yticks=[])
    bar = figure.colorbar(image, ax=panels, extend="both", fraction=0.03, pad=0.01, shrink=0.86)
    bar.set_label("% of white (red: too bright)")
    figure.text(0.012, 0.008, "\n".join(lines), fontsize=9, va="bottom", ha="left", linespacing=1.35)
    share = words_in / figure.get_figheight()
    figure.set_layout_engine("constrained", rect=(0.0, share, 1.0, 1.0 - share))
    return png_bytes(figure)
