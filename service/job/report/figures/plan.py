"""The trade-off as a picture: the light of plans of different length, and the gain of each hour."""

from __future__ import annotations

from textwrap import wrap
from typing import Literal

import numpy as np
from matplotlib.axes import Axes

from optics.irradiance import picture_from_irradiance
from service.job.planning.plan import Planned
from service.job.planning.sentences import finish_words, rest_words
from service.job.report.figures.base import new_figure, panel_height, png_bytes
from service.job.report.figures.wall import show_light
from service.wording import ball, duration

_INK, _MARK, _QUIET = "0.25", "#b5382a", "0.55"
_WIDE_IN, _LEAST_WIDTH_IN = 3.1, 9.5  # of a picture; of the figure, so that the words of the curve fit
_CAPTION_CHARS = 48  # as many as fit under a picture


def plan_png(planned: Planned, *, viewed_from: Literal["lens", "behind"]) -> bytes:
    """Draw target, three plans from quick to best, and the curve of all; the choice is marked."""
    shown = planned.choices
    target = planned.light.target
    white = float(target.max())
    columns = 1 + len(shown)
    tall = panel_height(_WIDE_IN, *target.shape)
    figure = new_figure(max(_WIDE_IN * columns + 0.2, _LEAST_WIDTH_IN), tall + 4.1)
    above, below = np.atleast_1d(np.asarray(figure.subfigures(2, 1, height_ratios=(tall + 1.05, 3.05))))
    panels = above.subplots(1, columns, squeeze=False)[0]
    _draw_picture(panels[0], picture_from_irradiance(target, viewed_from=viewed_from), white, "Picture wanted", "")
    for axes, one in zip(panels[1:], shown, strict=True):
        score = planned.score(one)
        title = f"{duration(3600 * one.hours)}: SSIM {score.ssim:.2f}, {one.psnr_db:.1f} dB"
        rows = (finish_words(one.finish), rest_words(one), f"blur {one.blur_mm:.2g} mm")
        words = "\n".join(line for row in rows if row for line in wrap(str(row), _CAPTION_CHARS))
        picture = picture_from_irradiance(planned.picture(one), viewed_from=viewed_from)
        _draw_picture(axes, picture, white, title, words, marked=one is planned.chosen)
    _draw_curve(below.subplots(), planned)
    return png_bytes(figure)


def _draw_picture(
    axes: Axes, picture: np.ndarray, white: float, title: str, words: str, *, marked: bool = False
) -> None:
    show_light(axes, picture, white, interpolation="nearest")
    axes.set_title(title, fontsize=10, color=_MARK if marked else _INK, fontweight="bold" if marked else "normal")
    axes.set_xlabel(words, fontsize=8.5, color=_INK)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=_MARK if marked else "0.8", linewidth=2.0 if marked else 0.6)


def _draw_curve(axes: Axes, planned: Planned) -> None:
    front, chosen = planned.plan.front, planned.chosen
    hours, psnr = [one.hours for one in front], [one.psnr_db for one in front]
    axes.plot(hours, psnr, "-", color=_QUIET, linewidth=1.2, zorder=1)
    axes.plot(hours, psnr, "o", color=_INK, markersize=4, zorder=2)
    axes.plot([chosen.hours], [chosen.psnr_db], "o", color=_MARK, markersize=9, zorder=3)
    words = f"chosen: ball {ball(chosen.finish.radius_mm)}, pitch {chosen.finish.pitch_mm:g} mm"
    if chosen.rest is not None:
        words += f",\nthen ball {ball(chosen.rest.spec.radius_mm)}"
    late = chosen.hours**2 > hours[0] * hours[-1]  # in the right half of the axis
    axes.annotate(
        words, (chosen.hours, chosen.psnr_db), xytext=(4, -44) if late else (10, -16), textcoords="offset points",
        ha="right" if late else "left", fontsize=9, color=_MARK,
    )  # fmt: skip
    axes.set_xscale("log")
    ticks = _ticks(hours[0], hours[-1])
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("machine time of all passes, h", fontsize=9, color=_INK)
    axes.set_ylabel("predicted PSNR, dB", fontsize=9, color=_INK)
    noise, step = 1000 * planned.machine.z_noise_mm, 1000 * planned.machine.step_mm
    axes.set_title(
        f"What each hour brings on '{planned.machine.name}': steps {step:g} µm, height noise {noise:g} µm",
        fontsize=10, color=_INK, loc="left",
    )  # fmt: skip
    axes.tick_params(labelsize=8.5, colors=_INK)
    axes.grid(alpha=0.25, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    best = planned.plan.best
    axes.axhline(best.psnr_db, color=_QUIET, linewidth=0.8, linestyle=":")
    axes.margins(x=0.04, y=0.14)


def _ticks(low: float, high: float) -> list[float]:
    """Return a few round numbers between two hours: the coarsest series that gives three."""
    for bases in ((1, 2, 5), (1, 1.5, 2, 3, 5, 7), tuple(part / 10 for part in range(10, 100))):
        every = [base * 10.0**power for power in range(-3, 5) for base in bases]
        inside = [tick for tick in every if low * 0.99 <= tick <= high * 1.01]
        if len(inside) >= 3:
            return inside[:: -(-len(inside) // 9)]
    return sorted({round(low, 2), round(high, 2)})
