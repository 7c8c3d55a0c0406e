"""Figures 13 and 14: the milling path, and the surface that passes leave."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource

from cam.passes import PAPER_PASSES, PassSpec
from cam.reading.gcode import MoveBatch
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from service.job.report.figures.path_sample import ContourSample
from tests.paper import figures
from tests.paper.cases import INDEX, SIDE_MM, THROW_MM
from tests.paper.machined import FinishPath, MilledPass, finish_path, lens_to_mill, moves_of, skin_over, three_passes
from tests.paper.portrait import MAIN
from tests.paper.section import Section, Sizes

FINISH = PAPER_PASSES[2]
WAYS = {
    "rows, lifted (the paper)": replace(FINISH, link="retract"),
    "rows, turns on the surface": FINISH,
    "along the contour lines": replace(FINISH, strategy="contour"),
}
DRAWN_MM, PIECES_MM = 3.0, 0.2  # pitches of the paths that are drawn
CORNER = 0.47  # of the lens's side: lower left of what is shown closely
SIDES_MM = (2.5, 0.25, 0.1)  # of the square shown of each pass: some five rows


def figure_13(sizes: Sizes, folder: Path) -> Section:
    lens = lens_to_mill(MAIN, sizes.main, sizes.milled_mm)
    drawn = {words: _drawn(lens, spec) for words, spec in WAYS.items() if spec.strategy == "raster"}
    seen = [(words, _from_above(moves)) for words, moves in drawn.items()]
    seen.append(("along the contour lines", _pieces(lens, WAYS["along the contour lines"])))
    first = next(iter(drawn.values()))
    figures.panels(folder / "figure-13.jpg", [[("lifted rows, from the side", _aslant(first)), *seen]], side=3.4)
    found = {words: finish_path(lens, spec) for words, spec in WAYS.items()}
    lifted, turned, contour = found.values()
    rows = "\n".join(f"| {words} | {_path_row(path)} |" for words, path in found.items())
    verdict = (
        "one smooth connected path mostly along the contour lines would spare the entries that make stripes | "
        f"{lifted.measures.entries:,} entries and {lifted.time_s / 3600:.0f} h become "
        f"{contour.measures.entries} and {contour.time_s / 3600:.0f} h, "
        f"{100 * contour.measures.aligned_share:.0f} % along the contour"
    )
    return Section(
        f"13 | {verdict}",
        f"""## Figure 13: the milling path

*Claim*: every row ends with a lift, a way back and another entry into the material; each entry is a collision that
shifts the tool, and the picture shows it as stripes. A single smoothly connected path along the contour lines would
avoid that (section 5; left there as an idea). *Ours*: all three on the `{MAIN}` lens, milling black, the other ways
grey; rows are drawn {DRAWN_MM:g} mm apart, and of the contour path pieces that keep clear of each other. The figures
are those of the finishing programs, ball {FINISH.radius_mm:g} mm, pitch {FINISH.pitch_mm:g} mm, as they are
written, on a mill of 500 mm/s² (300 along Z), at {FINISH.feed_mm_per_min:g} mm/min.

![Figure 13](paper/figure-13.jpg)

| path | entries | machine time | time over length / feed | along the contour | length x pitch / area | widest gap |
|---|---|---|---|---|---|---|
{rows}

*Along the contour*: share of the length within 15 degrees of the contour line where the slope is above 1 %. *Widest
gap*: between neighbouring tracks anywhere, as found, in pitches; none above 1.02 can hide. Length of the contour path
with turns tighter than five pitches: {100 * contour.measures.tight_turn_share:.2f} %; corners above 60 degrees:
{contour.measures.turns_over_60_per_m:.2g} per metre. Rows with turns on the surface have one entry, too, and take
{turned.time_s / 3600:.0f} h.
""",
    )


def _path_row(path: FinishPath) -> str:
    found = path.measures
    nominal_s = 60 * found.length_mm / FINISH.feed_mm_per_min
    return (
        f"{found.entries:,} | {path.time_s / 3600:.1f} h | {path.time_s / nominal_s:.2f} | "
        f"{100 * found.aligned_share:.0f} % | {found.length_ratio:.2f} | {found.gap.width_mm / FINISH.pitch_mm:.3f}"
    )


def _drawn(lens: Heightfield, spec: PassSpec) -> list[MoveBatch]:
    """The same path with a ball and a pitch that can be seen."""
    coarse = replace(spec, radius_mm=DRAWN_MM, pitch_mm=DRAWN_MM, step_down_mm=1.0)
    return list(moves_of(lens, coarse, skin_over(lens)))


def _lines(batches: list[MoveBatch]) -> tuple[np.ndarray, np.ndarray]:
    """(k, 2, 3) moves that mill, and those that only go somewhere: at rapid or plunge feed."""
    moves = np.concatenate([np.stack([batch.start_mm, batch.end_mm], axis=1) for batch in batches])
    mills = np.concatenate([~batch.is_rapid & (batch.feed_mm_per_min == FINISH.feed_mm_per_min) for batch in batches])
    return moves[mills], moves[~mills]


def _from_above(batches: list[MoveBatch]) -> figures.Draw:
    mills, others = _lines(batches)

    def draw(axes: Axes) -> None:
        axes.add_collection(LineCollection(others[:, :, :2], colors="0.65", linewidths=0.9))
        axes.add_collection(LineCollection(mills[:, :, :2], colors="black", linewidths=0.55))
        axes.autoscale()
        axes.set_aspect("equal")

    return draw


def _pieces(lens: Heightfield, spec: PassSpec) -> figures.Draw:
    """Evenly strewn pieces of a contour path, as toolpath.png has them."""
    fine = replace(spec, pitch_mm=PIECES_MM)
    sample = ContourSample(
        label="", pitch_mm=PIECES_MM, radius_mm=fine.radius_mm, width_mm=lens.width_mm, height_mm=lens.height_mm
    )
    for batch in moves_of(lens, fine, skin_over(lens)):
        sample.add(batch.start_mm, batch.end_mm, batch.is_rapid)

    def draw(axes: Axes) -> None:
        axes.add_collection(LineCollection(sample.tracks_mm()[:, :, :2], colors="black", linewidths=0.55))
        axes.autoscale()
        axes.set_aspect("equal")

    return draw


def _aslant(batches: list[MoveBatch], rows: int = 6) -> figures.Draw:
    """The first rows as the paper's figure has them: x to the right, y to the back, heights doubled."""

    def flat(lines: np.ndarray) -> np.ndarray:
        lines = lines[lines[:, :, 1].max(axis=1) < (rows - 1) * DRAWN_MM]
        x, y, z = np.moveaxis(lines, -1, 0)
        return np.stack([x + 3.0 * y, 2.5 * y + 2.5 * z], axis=-1)

    mills, others = (flat(lines) for lines in _lines(batches))

    def draw(axes: Axes) -> None:
        axes.add_collection(LineCollection(others, colors="0.65", linewidths=0.9))
        axes.add_collection(LineCollection(mills, colors="black", linewidths=0.8))
        axes.autoscale()
        axes.set_aspect("equal")

    return draw


def figure_14(sizes: Sizes, folder: Path) -> Section:
    lens = lens_to_mill(MAIN, sizes.main, sizes.milled_mm)
    passes = three_passes(lens, CORNER * lens.width_mm, SIDES_MM)
    places = [
        (f"after {done.spec.name}, {side:g} mm wide", _raking(lens, done.place))
        for done, side in zip(passes, SIDES_MM, strict=True)
    ]
    cuts = [_section(lens, done) for done in passes]
    figures.panels(folder / "figure-14.jpg", [places, cuts], side=3.4)
    rows = "\n".join(f"| {_pass_row(lens, done)} |" for done in passes)
    hours = sum(done.verdict.time_s for done in passes) / 3600
    slope = _slope_rms_mrad(lens, passes[-1].section)
    theory = 1000 * FINISH.pitch_mm / (2 * FINISH.radius_mm * np.sqrt(3)) * _stretch(lens, passes[-1].section)
    blur_mm = (INDEX - 1) * THROW_MM * slope / 1000
    verdict = (
        f"three passes leave tiny bumps that bend the light; six days | {hours / 24:.1f} days; bumps of "
        f"{1000 * FINISH.pitch_mm**2 / 8 / FINISH.radius_mm:.2f} µm, slopes of {slope:.1f} mrad rms; "
        f"no cut deeper than {1000 * max(done.verdict.gouge_um for done in passes):.0f} nm below the lens"
    )
    return Section(
        f"14 | {verdict}",
        f"""## Figure 14: the surface that is milled

*Claim*: balls of 3, 0.5 and 0.5 mm at pitches of 0.5, 0.05 and 0.02 mm, some six days in all; the last pass leaves
bumps that make some light stray. *Ours*: the three programs, read back and cut in the computer on the whole lens.
Above, the surface in raking light after each pass; below, sections across the rows, heights over the lens (black), the
stock red; the paper's figure is drawn by hand, these are the programs' own cusps.

![Figure 14](paper/figure-14.jpg)

| pass | ball, pitch | machine time | entries | deepest bite | leaves: mean (wanted) | cusps | gouge |
|---|---|---|---|---|---|---|---|
{rows}

Together {hours:.0f} hours at the start values for acrylic; the paper gives no feeds. Along the section the finished
surface tilts by {slope:.1f} mrad rms against the lens; +-p / 2R, evenly spread, on the slope there is {theory:.1f}
mrad. That is {blur_mm:.2f} mm of blur on a wall 100 mm away, {512 * blur_mm / SIDE_MM:.1f} pixels of 512.
""",
    )


def _raking(lens: Heightfield, grid: StockGrid) -> figures.Draw:
    """What stands over the lens, as steep as shows best."""
    over = grid.top_mm - lens.spline().heights_mm(grid.x_mm[None, :], grid.y_mm[:, None])
    steep = float(np.sqrt(np.mean(np.gradient(over, grid.cell_mm)[0] ** 2)))
    shade = LightSource(azdeg=315, altdeg=40).hillshade(over / steep, dx=grid.cell_mm, dy=-grid.cell_mm, vert_exag=0.6)
    return lambda axes: axes.imshow(shade, origin="lower", cmap="gray") and None


def _over_lens_um(lens: Heightfield, grid: StockGrid) -> np.ndarray:
    """Stock over the lens along the section, (ny,)."""
    return 1000 * (grid.top_mm[:, 1] - lens.spline().heights_mm(np.full(grid.y_mm.size, grid.x_mm[1]), grid.y_mm))


def _section(lens: Heightfield, done: MilledPass) -> tuple[str, figures.Draw]:
    over, y = _over_lens_um(lens, done.section), done.section.y_mm

    def draw(axes: Axes) -> None:
        axes.axhline(0.0, color="black", linewidth=1.2)
        axes.plot(y, over, color="tab:red", linewidth=1.2)
        axes.set_ylim(-0.1 * over.max(), 1.15 * over.max())
        axes.text(0.02, 0.01, "lens", transform=axes.transAxes, fontsize=7)

    return f"across the rows: {over.min():.3g} to {over.max():.3g} µm over the lens", draw


def _slope_rms_mrad(lens: Heightfield, grid: StockGrid) -> float:
    slopes = np.diff(_over_lens_um(lens, grid)) / (1000 * grid.cell_mm)
    return 1000 * float(np.sqrt(np.mean(slopes**2)))


def _stretch(lens: Heightfield, grid: StockGrid) -> float:
    """How much steeper cusps stand on a slope across the rows, seen from above: 1 / cos^3."""
    steep = lens.spline().jets(np.full(grid.y_mm.size, grid.x_mm[1]), grid.y_mm)[2]
    return float(np.mean((1 + steep**2) ** 1.5))


def _pass_row(lens: Heightfield, done: MilledPass) -> str:
    spec, verdict = done.spec, done.verdict
    over = _over_lens_um(lens, done.section)
    cusp_um = 1000 * spec.pitch_mm**2 / 8 / spec.radius_mm
    return (
        f"{spec.name} | {spec.radius_mm:g} mm, {spec.pitch_mm:g} mm | {verdict.time_s / 3600:.1f} h | "
        f"{verdict.entries} | {verdict.max_engagement_mm:.2f} mm | "
        f"{over.mean():.2f} µm ({1000 * spec.stock_to_leave_mm:g} µm) | "
        f"{np.ptp(over):.2g} µm (p²/8R: {cusp_um:.2g} µm) | {1000 * verdict.gouge_um:.1f} nm"
    )
