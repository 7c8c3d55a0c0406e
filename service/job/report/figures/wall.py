"""PNG pictures of the light on the wall: target, caustic, as milled, out of focus, and small for a list of jobs.

A picture here is (ny, nx) linear irradiance as the viewer sees it, row 0 at the top. All pictures of one job share one
exposure: white is the brightest pixel of the target, brighter light is clipped, so that files can be compared by eye.
Every function returns the bytes of a PNG and writes nothing.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import uniform_filter

from service.job.picture.resampling import resize
from service.job.report.figures.base import COMPRESS_LEVEL, Array, new_figure, panel_height, png_bytes, round_up

_LEAST_SCALE_PERCENT = 0.1
_PART = 4  # a quarter of each side is shown enlarged
_QUIET: dict[str, Any] = {"fontsize": 9, "color": "0.35"}
THUMBNAIL_BYTES = 18_000
THUMBNAIL_SIDES = (192, 168, 144, 120)  # pixels of the longer side; the last fits even if nothing can be packed


def srgb_levels(picture: Array, *, white: float) -> NDArray[np.uint8]:
    """Convert linear irradiance (any shape) to 8 bit sRGB; `white` becomes 255, what is brighter is clipped.

    IEC 61966-2-1. Raises ValueError unless white is positive and finite.
    """
    if not (np.isfinite(white) and white > 0):
        raise ValueError(f"white must be a positive irradiance, not {white}")
    linear = np.clip(np.nan_to_num(np.asarray(picture, dtype=np.float64)) / white, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * encoded), dtype=np.uint8)


def show_light(axes: Axes, picture: Array, white: float, **look: Any) -> None:
    """Draw a picture (ny, nx) into axes; look: of `imshow`."""
    axes.imshow(srgb_levels(picture, white=white), cmap="gray", vmin=0, vmax=255, **look)


def picture_png(picture: Array, *, white: float, scale: int = 1) -> bytes:
    """Draw the plain picture (ny, nx), each pixel drawn as scale x scale pixels, as an 8 bit grey PNG."""
    levels = srgb_levels(picture, white=white).repeat(scale, axis=0).repeat(scale, axis=1)
    buffer = io.BytesIO()
    Image.fromarray(levels).save(buffer, format="PNG", compress_level=COMPRESS_LEVEL)
    return buffer.getvalue()


def row_png(pictures: Sequence[Array], *, white: float, side: int = 300) -> bytes:
    """Draw pictures (ny, nx) of one shape side by side, small, with a white gap between them and no words."""
    levels = [srgb_levels(_smaller(picture, side), white=white) for picture in pictures]
    gap = np.full((levels[0].shape[0], max(2, side // 30)), 255, dtype=np.uint8)
    row = np.hstack([part for one in levels for part in (gap, one)][1:])
    buffer = io.BytesIO()
    Image.fromarray(row).save(buffer, format="PNG", compress_level=COMPRESS_LEVEL)
    return buffer.getvalue()


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
    """Draw the picture as it was given and as the lens aims at it, both with the same amount of light."""
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


def thumbnail_png(picture: Array, *, white: float) -> bytes:
    """Return `picture_png`, small: a list of jobs shows dozens. The same exposure, averages of light, never enlarged.

    picture : (ny, nx) linear irradiance as the viewer sees it, row 0 on top
    """
    packed = b""
    for side in THUMBNAIL_SIDES:
        packed = picture_png(_smaller(picture, side), white=white)
        if len(packed) <= THUMBNAIL_BYTES:
            break
    return packed


def _smaller(picture: Array, side: int) -> Array:
    scale = side / max(picture.shape)
    if scale >= 1.0:
        return picture
    ny, nx = (max(1, round(scale * length)) for length in picture.shape)
    return resize(picture, (ny, nx))
