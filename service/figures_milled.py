"""PNG figure of the picture as milled: target, design and milled surface, whole and a part of it enlarged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from service.figures import Array, new_figure, panel_height, png_bytes, srgb_levels

_PART = 4  # a quarter of each side is shown enlarged


def as_milled_png(target: Array, designed: Array, milled: Array, *, figures: Mapping[str, Any]) -> bytes:
    """Pictures (ny, nx) as the viewer sees them, row 0 on top; figures: report `as_milled`."""
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
            axes.imshow(srgb_levels(shown, white=white), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        panels[0, k].set_title(caption, fontsize=10)
    return png_bytes(figure)


def busiest_part(picture: Array) -> tuple[slice, slice]:
    """The quarter of each side in which the picture changes most from pixel to pixel."""
    ny, nx = picture.shape
    high, wide = max(ny // _PART, min(8, ny)), max(nx // _PART, min(8, nx))
    change = np.hypot(*np.gradient(picture))
    mean = uniform_filter(change, (high, wide), mode="constant")[high // 2 : ny - high // 2, wide // 2 : nx - wide // 2]
    if mean.size == 0:
        return slice(0, ny), slice(0, nx)
    j, i = divmod(int(mean.argmax()), mean.shape[1])
    return slice(j, j + high), slice(i, i + wide)
