"""Generates one pass from heightfield to text: surface, layers, exact rows, blocks. It streams; nothing here opens a
file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from math import inf

import numpy as np

from cam.contour.path import contour_path
from cam.errors import CutterTooLargeError, PassValueError, SafeHeightError, StockTooThinError
from cam.materials import SLOT_FEED
from cam.moves import SAFE_Z_MM, Array, Path, cut
from cam.parts import PartLimits, PassFrame, programs
from cam.passes import PassSpec, Stock
from cam.posts.dialects import Dialect
from cam.posts.post import ProgramSetup
from cam.posts.remarks import describe_pass
from cam.rows.entries import enter, enter_onward, leave
from cam.rows.layers import CUSP_MM, Field, Layer, LayerPlan, layer_paths, plan_layers
from cam.rows.loads import first_row, most_feed_mm_per_min, row_cuts
from cam.rows.raster import (
    Rows,
    climbs_rightward,
    continuous_rows,
    sample_rows,
    separate_rows,
    turn_block,
    turn_lens,
    turn_paths,
    turn_stock,
)
from cam.rows.rest import RestAreas, rest_paths
from cam.rows.rounding import Rounding, on_raster
from cam.rows.vertices import SLOPE_ERROR_RAD, VertexRule, finish_rule, rough_rule
from cam.shaping import ShapedRegion, shape_heights
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_touch import StockTouch, find_reached_share, largest_fitting_radius_mm
from cam.surface.tool_surface import RoughSurface, Surface, ToolSurface, surface_under
from optics.heightfield import Heightfield
from phrases.phrase import Phrase

Progress = Callable[[float], None]

SHAPED_SLOPE_ERROR_RAD = 8e-3
"""For a path whose heights are shaped: a finish levels waves as short as a move. `camera` in steps of 4 um: 25.92 dB at
2 mrad and at 8, with five sixths of the lines; a soft photograph in steps of 2 um: 34.21 and 34.19 dB."""

CHUNK_BYTES = 1_000_000
LEAST_REACHED = 0.9
"""Least share of the surface that a finishing ball must touch to make a lens."""


def generate_parts(
    heightfield: Heightfield,
    spec: PassSpec,
    stock: Stock,
    *,
    stock_top: StockGrid,
    post: Dialect,
    safe_z_mm: float = SAFE_Z_MM,
    slope_error_rad: float = SLOPE_ERROR_RAD,
    limits: PartLimits | None = None,
    step_mm: float = 0.0,
    shaped: bool = False,
    number: int = 1,
    setup: ProgramSetup | None = None,
    trace: tuple[Path, ...] = (),
    on_progress: Progress | None = None,
) -> Iterator[Iterator[bytes]]:
    """Return the pass as one program after the other, each within the limits; read each to its end before the next.

    Text comes in pieces of about a megabyte; memory does not grow with the program. Raises CutterTooLargeError,
    StockTooThinError, SafeHeightError or PassValueError before the first piece.

    step_mm : above 0 if heights must be in whole steps of the mill; number: of the pass, from 1
    setup   : what programs switch on and off; trace: paths in the air that the first of them runs before it cuts
    shaped  : the lens will be finished by hand, so errors of these steps alternate from track to track (`cam.shaping`)
    """
    rounding = Rounding(digits=post.digits.coarsen(step_mm), pitch_mm=spec.pitch_mm)
    shaped = shaped and spec.finishes and rounding.matters
    paths = pass_paths(
        heightfield,
        spec,
        stock,
        stock_top=stock_top,
        safe_z_mm=safe_z_mm,
        slope_error_rad=max(slope_error_rad, SHAPED_SLOPE_ERROR_RAD) if shaped else slope_error_rad,
        on_progress=on_progress,
    )
    frame = PassFrame(
        remarks=describe_pass(spec, stock),
        rpm=spec.spindle_rpm,
        plunge_mm_per_min=spec.plunge_mm_per_min,
        safe_z_mm=safe_z_mm,
        aperture_mm=(stock.width_mm, stock.height_mm),
        number=number,
        setup=setup or ProgramSetup(),
        trace=trace,
    )
    if shaped:
        paths = shape_heights(paths, rounding, _region(spec, stock))
    elif spec.finishes and rounding.matters:
        paths = on_raster(paths, rounding)
    return map(_gather_chunks, programs(paths, post, frame, limits))


def _region(spec: PassSpec, stock: Stock) -> ShapedRegion:
    """Return the aperture grown by one radius, which no track leaves."""
    ring = spec.radius_mm
    return ShapedRegion(
        low_mm=(-ring, -ring), high_mm=(stock.width_mm + ring, stock.height_mm + ring), radius_mm=spec.radius_mm
    )


def _gather_chunks(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the same bytes in pieces of at least CHUNK_BYTES, the last one excepted."""
    held: list[bytes] = []
    size = 0
    for piece in pieces:
        held.append(piece)
        size += len(piece)
        if size >= CHUNK_BYTES:
            yield b"".join(held)
            held, size = [], 0
    if held:
        yield b"".join(held)


def pass_paths(
    heightfield: Heightfield,
    spec: PassSpec,
    stock: Stock,
    *,
    stock_top: StockGrid,
    safe_z_mm: float = SAFE_Z_MM,
    slope_error_rad: float = SLOPE_ERROR_RAD,
    on_progress: Progress | None = None,
) -> Iterator[Path]:
    """Yield moves of one pass between safe heights: layers where there is too much stock, then the surface.

    The first move is a rapid at safe height: the writer of the program brings the tool up there before it.
    """
    along_y = spec.direction == "y"
    if along_y:
        heightfield, stock, stock_top = turn_lens(heightfield), turn_block(stock), turn_stock(stock_top)
    paths = _paths_along_x(heightfield, spec, stock, stock_top, safe_z_mm, slope_error_rad, on_progress)
    yield from turn_paths(paths) if along_y else paths


def _paths_along_x(
    heightfield: Heightfield,
    spec: PassSpec,
    stock: Stock,
    stock_top: StockGrid,
    safe_z_mm: float,
    slope_error_rad: float,
    on_progress: Progress | None,
) -> Iterator[Path]:
    surface = surface_under(heightfield, spec)
    _check_job(heightfield, spec, stock, surface, safe_z_mm, slope_error_rad)
    met, rows, field, plan = _look(surface, stock, stock_top, spec)
    above = plan.layers[-1] if plan.layers else None
    report = on_progress or (lambda fraction: None)
    if plan.only_between:
        rows = rows.between(plan.stride)
    share = _layer_share(field, rows, plan)
    yield from _all_layers(field, surface, met, plan, spec, safe_z_mm, lambda done: report(share * done))
    del field
    rule = _vertex_rule(heightfield, spec, slope_error_rad)
    if spec.where == "rest":
        assert isinstance(surface, ToolSurface)  # a ball's, as PassSpec requires
        most_mm = above.offset_mm + CUSP_MM if above else inf
        yield from rest_paths(
            *(RestAreas.of(stock_top, heightfield, spec), surface, met, rows, rule, spec),
            most_mm=most_mm,
            safe_z_mm=safe_z_mm,
            on_progress=lambda done: report(share + (1 - share) * done),
        )
    elif plan.exact_rows:
        if plan.only_between:  # only cusps are left there
            spec = replace(spec, feed_mm_per_min=float(most_feed_mm_per_min(spec, heightfield.steepest)))
        polylines = _polylines(heightfield, surface, rows, rule, spec, lambda done: report(share + (1 - share) * done))
        yield from _polyline_paths(polylines, met, above, CUSP_MM + plan.stair_mm, spec, safe_z_mm=safe_z_mm)
    report(1.0)


def layer_paths_alone(
    heightfield: Heightfield, spec: PassSpec, stock: Stock, *, stock_top: StockGrid, safe_z_mm: float
) -> Iterator[Path]:
    """Yield only the layers of a pass, without its exact rows; nothing if no move meets more than its step-down."""
    if spec.direction == "y":
        heightfield, stock, stock_top = turn_lens(heightfield), turn_block(stock), turn_stock(stock_top)
    surface = surface_under(heightfield, spec)
    met, _, field, plan = _look(surface, stock, stock_top, spec)
    yield from _all_layers(field, surface, met, plan, spec, safe_z_mm, lambda fraction: None)


def _look(
    surface: Surface, stock: Stock, stock_top: StockGrid, spec: PassSpec
) -> tuple[StockTouch, Rows, Field, LayerPlan]:
    """Find the stock above the surface and plan layers; their field has only their own rows."""
    rows = Rows.over(stock, spec)
    met = StockTouch.of(stock_top, spec.radius_mm, spec.shape)
    if spec.where == "rest" and met.flat:
        raise PassValueError(name="where", value="rest", allowed=Phrase("only after a pass that has cut the shape"))
    field = Field.along(rows, surface, met).refine(met, spec.step_down_mm - met.slack_mm)
    plan = plan_layers(field, met, spec)
    return met, rows, field.every(plan.stride), plan  # only the exact rows need the pitch


def _vertex_rule(heightfield: Heightfield, spec: PassSpec, slope_error_rad: float) -> VertexRule:
    probe = min(heightfield.dx_mm, spec.radius_mm / 2)
    if not spec.finishes:
        return rough_rule(spec.stock_to_leave_mm, probe)
    return finish_rule(slope_error_rad, probe, aperture_x_mm=(0.0, heightfield.width_mm))


def _check_job(
    heightfield: Heightfield,
    spec: PassSpec,
    stock: Stock,
    surface: Surface,
    safe_z_mm: float,
    slope_error_rad: float,
) -> None:
    """Check everything that can be known before the first move."""
    if not slope_error_rad > 0:
        raise PassValueError(name="slope_error_rad", value=slope_error_rad, allowed=Phrase("above {least:g}", least=0))
    for name in ("width_mm", "height_mm"):
        if abs(getattr(stock, name) - getattr(heightfield, name)) > 1e-6:
            raise PassValueError(
                name=f"stock.{name}",
                value=getattr(stock, name),
                allowed=Phrase("the lens's {size_mm:g}", size_mm=getattr(heightfield, name)),
            )
    if surface.lowest_mm < -stock.thickness_mm:
        raise StockTooThinError(lowest_mm=surface.lowest_mm, thickness_mm=stock.thickness_mm)
    needed = max(0.0, surface.highest_mm) + 1.0
    if safe_z_mm < needed:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=needed)
    if spec.finishes:
        share = find_reached_share(heightfield, spec.radius_mm)
        if share < LEAST_REACHED:
            largest = largest_fitting_radius_mm(heightfield)
            raise CutterTooLargeError(
                radius_mm=spec.radius_mm,
                reached_share=share,
                largest_mm=largest.everywhere_mm,
                nearly_mm=largest.nearly_mm,
            )


def _layer_share(field: Field, rows: Rows, plan: LayerPlan) -> float:
    """Return the layers' share of the work, by rows."""
    layers = len(plan.layers) * field.rows.y_mm.size
    return layers / (layers + rows.y_mm.size * plan.exact_rows)


def _all_layers(
    field: Field,
    surface: Surface,
    met: StockTouch,
    plan: LayerPlan,
    spec: PassSpec,
    safe_z_mm: float,
    report: Progress,
) -> Iterator[Path]:
    above: Layer | None = None
    for index, layer in enumerate(plan.layers):

        def on_progress(part: float, done: int = index) -> None:
            report((done + part) / len(plan.layers))

        yield from layer_paths(
            *(field, surface, met, layer, above, spec),
            stair_mm=plan.stair_mm,
            safe_z_mm=safe_z_mm,
            on_progress=on_progress,
        )
        above = layer


def _polylines(
    heightfield: Heightfield, surface: Surface, rows: Rows, rule: VertexRule, spec: PassSpec, report: Progress
) -> Iterator[Array]:
    """Yield the exact surface: pieces of one path, or separate rows."""
    if spec.strategy == "contour":
        assert isinstance(surface, ToolSurface)  # a ball's, as PassSpec requires
        yield from contour_path(heightfield, surface, spec, rule, on_progress=report)
        return
    if isinstance(surface, RoughSurface):
        polylines = sample_rows(surface, rows, rule.sag_mm)
    elif spec.link == "u-turn":
        polylines = continuous_rows(surface, rows, rule)
    else:
        polylines = separate_rows(surface, rows, rule, rightward=climbs_rightward(spec))
    low, high = rows.y_mm[0], rows.y_mm[-1]
    for polyline in polylines:
        yield polyline
        report(float((polyline[-1, 1] - low) / (high - low)))


def _polyline_paths(
    polylines: Iterator[Array],
    met: StockTouch,
    above: Layer | None,
    cusp_mm: float,
    spec: PassSpec,
    *,
    safe_z_mm: float,
) -> Iterator[Path]:
    """Yield one unbroken path, or rows that are each entered and left separately."""

    def meets(tips_mm: Array) -> Array:
        heights = met.under(tips_mm) + met.slack_mm
        return heights if above is None else np.minimum(heights, above.tips_mm(tips_mm[:, 2]) + cusp_mm)

    lifts = spec.strategy == "raster" and spec.link == "retract"
    onward = spec.strategy == "contour"
    last = np.empty(3)
    for index, polyline in enumerate(polylines):
        if lifts or index == 0:
            if index:
                yield leave(last[0], last[1], safe_z_mm=safe_z_mm)
            first, height = first_row(polyline), float(meets(polyline[:1])[0])
            yield from (enter_onward if onward else enter)(first, height, spec, safe_z_mm=safe_z_mm)
            last = polyline[0]
        if index == 0:  # stock stands on both sides of the first row
            if not onward:
                yield cut(first, SLOT_FEED * spec.feed_mm_per_min)
            last, polyline = first[-1], polyline[len(first) :]
        if len(polyline):
            yield from [cut(polyline, spec.feed_mm_per_min)] if onward else row_cuts(polyline, last, meets, spec)
            last = polyline[-1]
    yield leave(last[0], last[1], safe_z_mm=safe_z_mm)
