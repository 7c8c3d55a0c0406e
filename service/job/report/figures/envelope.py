"""envelope.png: block, clamps and tool between the table and the mill's head, from the front, to scale.

Left: the tool at its lowest, where its axis comes nearest to a clamp. Right: at the safe height, where rapids cross and
programs begin and end. Heights are over the table. The drawing shows the tool that sticks out farthest.
"""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from cam.checking.envelope import Envelope, Reach
from service.job.report.figures.base import new_figure, png_bytes

_TABLE, _BASE, _BLOCK, _CLAMP, _NOSE, _TOOL = "#8795a1", "#e3d5b8", "#dfe8f0", "#c77700", "#aab4be", "#1d5c8c"
_INK, _MARK = "#1f2933", "#b3261e"
_BESIDE_MM = 30.0


def envelope_png(envelope: Envelope, reach: Reach, *, file: str, machine: str, base_mm: float) -> bytes:
    """Draw both positions of one program's tool. base_mm : height of the base under the block"""
    figure = new_figure(10.0, 4.6)
    zero_mm = base_mm + envelope.thickness_mm
    stick_out_mm = envelope.stick_out_mm(reach)
    places = (
        (envelope.area_mm(reach)[0], zero_mm + reach.lowest_mm, f"at its lowest, Z{reach.lowest_mm:.4g}"),
        (envelope.width_mm / 2, zero_mm + envelope.safe_z_mm, f"rapids, Z{envelope.safe_z_mm:.4g}"),
    )
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (x_mm, tip_mm, title) in zip(panels, places, strict=True):
        _draw_table(axes, envelope, base_mm)
        _draw_tool(axes, envelope, reach, x_mm, tip_mm, stick_out_mm)
        axes.set_title(title, fontsize=9, color=_INK, loc="left")
        axes.set_aspect("equal")
        axes.set_xlabel("X, mm", fontsize=8, color=_INK)
        axes.tick_params(labelsize=8)
    panels[0].set_ylabel("over the table, mm", fontsize=8, color=_INK)
    top_mm = max(zero_mm + envelope.safe_z_mm + stick_out_mm + 25.0, 1.05 * (envelope.bed_to_collet_mm or 0.0))
    panels[0].set_ylim(-8.0, top_mm)
    lies = f"lies {base_mm:.4g} mm above the table" if base_mm else "lies on the table"
    figure.suptitle(
        f"{file} on {machine}: the tool sticks out {stick_out_mm:.1f} mm; the block {lies}",
        fontsize=10,
        color=_INK,
    )
    return png_bytes(figure)


def _draw_table(axes: Axes, envelope: Envelope, base_mm: float) -> None:
    """Draw what stands still, and the range of the collet's face."""
    margin_mm, width_mm = envelope.margin_mm, envelope.width_mm + 2 * envelope.margin_mm
    zero_mm, left_mm, right_mm = (
        base_mm + envelope.thickness_mm, -margin_mm - _BESIDE_MM, envelope.width_mm + margin_mm + _BESIDE_MM,
    )  # fmt: skip
    _box(axes, left_mm, -8.0, right_mm - left_mm, 8.0, _TABLE)
    _box(axes, -margin_mm, 0.0, width_mm, base_mm, _BASE)
    for clamp in envelope.clamps:
        _box(axes, clamp.x_mm, 0.0, clamp.width_mm, zero_mm + clamp.height_mm, _CLAMP, alpha=0.55)
    _box(axes, -margin_mm, base_mm, width_mm, envelope.thickness_mm + envelope.top_mm, _BLOCK)
    axes.text(
        width_mm / 2 - margin_mm, base_mm + envelope.thickness_mm / 2, "block", fontsize=8, ha="center", va="center",
        color=_INK, bbox={"facecolor": _BLOCK, "edgecolor": "none", "pad": 1.5},
    )  # fmt: skip
    heights: list[tuple[float, str, str]] = []
    if (top_mm := envelope.bed_to_collet_mm) is not None:
        heights += [(top_mm, "collet, highest", _INK), (top_mm - envelope.travel_z_mm, "collet, lowest", _INK)]
    if envelope.gantry_mm is not None and envelope.gantry_mm != envelope.bed_to_collet_mm:
        heights.append((envelope.gantry_mm, "gantry", _INK))
    axes.plot([left_mm, right_mm], [zero_mm, zero_mm], "--", color=_MARK, linewidth=0.8)
    axes.text(left_mm, zero_mm + 0.8, " Z0", fontsize=7, color=_MARK)
    for height_mm, words, colour in heights:
        axes.plot([left_mm, right_mm], [height_mm, height_mm], "--", color=colour, linewidth=0.8)
        axes.text(right_mm, height_mm + 0.8, words, fontsize=7, ha="right", color=colour)
    axes.set_xlim(left_mm, right_mm)


def _draw_tool(axes: Axes, envelope: Envelope, reach: Reach, x_mm: float, tip_mm: float, stick_out_mm: float) -> None:
    """Draw the cutter and, from the collet's face up, the nose."""
    collet_mm = tip_mm + stick_out_mm
    _box(axes, x_mm - reach.radius_mm, tip_mm, 2 * reach.radius_mm, stick_out_mm, _TOOL)
    for (radius_mm, over_mm), (_, length_mm) in zip(envelope.list_steps(), envelope.nose_mm, strict=True):
        _box(axes, x_mm - radius_mm, collet_mm + over_mm, 2 * radius_mm, length_mm, _NOSE)
    axes.plot([x_mm], [collet_mm], "_", color=_MARK, markersize=14)


def _box(axes: Axes, x: float, y: float, width: float, height: float, colour: str, alpha: float = 1.0) -> None:
    axes.add_patch(Rectangle((x, y), width, height, facecolor=colour, edgecolor=_INK, linewidth=0.7, alpha=alpha))
