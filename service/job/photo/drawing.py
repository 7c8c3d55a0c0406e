"""look.png: the photograph in the picture's own place beside what was foretold, and what was found."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

from service.job.report.figures.base import Array, new_figure, panel_height, png_bytes, round_up
from service.job.report.figures.wall import show_light

_COLUMNS = 180
_LINE_IN = 0.19


def look_png(rectified: Array, foretold: Array, sentences: Sequence[str]) -> bytes:
    """Draw rectified and foretold (ny, nx): irradiance as the viewer sees it, of one scale; NaN: not in the
    photograph.
    """
    lines = [line for text in sentences for line in textwrap.wrap(f"• {text}", _COLUMNS, subsequent_indent="   ")]
    white = float(np.quantile(foretold, 0.998))
    high = panel_height(4.0, *foretold.shape)
    words_in = 0.15 + _LINE_IN * len(lines) if lines else 0.0
    figure = new_figure(12.9, 0.6 + high + words_in)
    panels = figure.subplots(1, 3)
    for axes, title, picture in zip(
        panels, ("Photograph, set straight", "Foretold"), (rectified, foretold), strict=False
    ):
        shown = np.where(np.isfinite(picture), picture, white)
        show_light(axes, shown, white)
        axes.set_title(title, fontsize=11)
    difference = 100.0 * (rectified - foretold) / white
    limit = round_up(max(float(np.nanpercentile(np.abs(difference), 98.0)), 1.0))
    image = panels[2].imshow(difference, cmap="RdBu_r", vmin=-limit, vmax=limit)
    panels[2].set_title("Difference: photograph \N{MINUS SIGN} foretold", fontsize=11)
    panels[2].set_facecolor("0.8")
    for axes in panels:
        axes.set(xticks=[], yticks=[])
    bar = figure.colorbar(image, ax=panels, extend="both", fraction=0.03, pad=0.01, shrink=0.86)
    bar.set_label("% of white (red: too bright)")
    figure.text(0.012, 0.008, "\n".join(lines), fontsize=9, va="bottom", ha="left", linespacing=1.35)
    share = words_in / figure.get_figheight()
    figure.set_layout_engine("constrained", rect=(0.0, share, 1.0, 1.0 - share))
    return png_bytes(figure)
