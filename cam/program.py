"""One pass from heightfield to text: surface, layers, exact rows, blocks. A stream; nothing here opens a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain

import numpy as np

from cam.cutter import largest_fitting_radius_mm, reached_share
from cam.entries import enter, leave
from cam.errors import CutterTooLargeError, PassValueError, SafeHeightError, StockTooThinError
from cam.layers import Field, Layer, LayerPlan, layer_paths, plan_layers
from cam.moves import Array, Path, cut
from cam.passes import PassSpec, Stock
from cam.posts.post import Post, ProgramWriter, number
from cam.raster import Rows, continuous_rows, separate_rows
from cam.stock_grid import StockGrid
from cam.stock_touch import StockTouch
from cam.tool_surface import ToolSurface
from cam.vertices import VertexRule, finish_rule, rough_rule
from optics.heightfield import Heightfield

Progress = Callable[[float], None]

SLOPE_ERROR_RAD = 0.5e-3
SAFE_Z_MM = 5.0
CHUNK_BYTES = 1_000_000
CUSP_MM = 0.05
"""More than the layers' tolerance and cusps can leave above their tips."""

LEAST_REACHED = 0.9
"""A finishing ball that touches less of the surface than this makes no lens."""


def generate_program(
    heightfield: Heightfield,
    spec: PassSpec,
    stock: Stock,
    *,
    stock_top: StockGrid,
    post: Post,
    safe_z_mm: float = SAFE_Z_MM,
    slope_error_rad: float = SLOPE_ERROR_RAD,
    on_progress: Progress | None = None,
) -> Iterator[bytes]:
    """The pass as text in pieces of about a megabyte; memory does not grow with the program's length.

    Raises CutterTooLargeError, StockTooThinError, SafeHeightError or PassValueError before the first piece.
    """
    paths = pass_paths(
        heightfield,
        spec,
        stock,
        stock_top=stock_top,
        safe_z_mm=safe_z_mm,
        slope_error_rad=slope_error_rad,
        on_progress=on_progress,
    )
    writer = ProgramWriter(post)
    first = writer.start(remarks(spec, stock), rpm=spec.spindle_rpm, safe_z_mm=safe_z_mm)
    moves = chain.from_iterable(writer.write(path) for path in paths)
    yield from _gathered(chain([first], moves, _last(writer, safe_z_mm)))


def _last(writer: ProgramWriter, safe_z_mm: float) -> Iterator[bytes]:
    yield writer.end(safe_z_mm=safe_z_mm)  # only once all moves are out: it forgets the modal state


def _gathered(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """The same bytes in pieces of at least CHUNK_BYTES, the last one excepted."""
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


def remarks(spec: PassSpec, stock: Stock) -> tuple[str, ...]:
    """What the operator should see at the top of the file."""
    n = number
    block = f"{n(stock.width_mm + 2 * stock.margin_mm)} x {n(stock.height_mm + 2 * stock.margin_mm)}"
    return (
        f"pass {spec.name}: ball end mill radius {n(spec.radius_mm)} mm, pitch {n(spec.pitch_mm)} mm",
        f"leaves {n(spec.stock_to_leave_mm)} mm, step-down {n(spec.step_down_mm)} mm",
        f"block {block} x {n(stock.thickness_mm)} mm, margin {n(stock.margin_mm)} mm",
        "X0 Y0: lower left corner of the lens aperture, Z0: top of the block, mm",
    )


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
    """Moves of one raster pass, from safe height back to safe height: layers where the stock asks for them, then rows.

    The first move is a rapid at safe height: whoever writes the program brings the tool up there before it.
    """
    surface = ToolSurface.over(heightfield, radius_mm=spec.radius_mm, allowance_mm=spec.stock_to_leave_mm)
    _check_job(heightfield, spec, stock, surface, safe_z_mm, slope_error_rad)
    rows = Rows.over(stock, spec)
    met = StockTouch.of(stock_top, spec.radius_mm)
    field = Field.along(rows, surface, met)
    plan = plan_layers(field, met, spec)
    if plan.layers and plan.exact_rows:
        # Only the exact rows need the pitch; at a fifth of the radius the layers' cusps are 0.5 % of it.
        stride = max(1, int(spec.radius_mm / 5 / spec.pitch_mm))
        field = Field.along(rows.every(stride), surface, met) if stride > 1 else field
    above = plan.layers[-1] if plan.layers else None
    report = on_progress or (lambda fraction: None)
    share = _layer_share(field, rows, plan)
    yield from _all_layers(field, surface, met, plan, spec, safe_z_mm, lambda done: report(share * done))
    del field
    if plan.exact_rows:
        rule = _vertex_rule(heightfield, spec, slope_error_rad)
        polylines = (continuous_rows if spec.link == "u-turn" else separate_rows)(surface, rows, rule)
        counted = _counting(polylines, rows, lambda done: report(share + (1 - share) * done))
        yield from _rows_paths(counted, met, above, spec, safe_z_mm=safe_z_mm)
    report(1.0)


def _vertex_rule(heightfield: Heightfield, spec: PassSpec, slope_error_rad: float) -> VertexRule:
    probe = min(heightfield.dx_mm, spec.radius_mm / 2)
    if not spec.finishes:
        return rough_rule(spec.stock_to_leave_mm, probe)
    return finish_rule(slope_error_rad, probe, aperture_x_mm=(0.0, heightfield.width_mm))


def _check_job(
    heightfield: Heightfield,
    spec: PassSpec,
    stock: Stock,
    surface: ToolSurface,
    safe_z_mm: float,
    slope_error_rad: float,
) -> None:
    """Everything that can be known before the first move."""
    if not slope_error_rad > 0:
        raise PassValueError(name="slope_error_rad", value=slope_error_rad, allowed="above 0")
    for name in ("width_mm", "height_mm"):
        if abs(getattr(stock, name) - getattr(heightfield, name)) > 1e-6:
            raise PassValueError(
                name=f"stock.{name}", value=getattr(stock, name), allowed=f"the lens's {getattr(heightfield, name):g}"
            )
    if surface.lowest_mm < -stock.thickness_mm:
        raise StockTooThinError(lowest_mm=surface.lowest_mm, thickness_mm=stock.thickness_mm)
    needed = max(0.0, surface.highest_mm) + 1.0
    if safe_z_mm < needed:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=needed)
    if spec.finishes:
        share = reached_share(heightfield, spec.radius_mm)
        if share < LEAST_REACHED:
            largest = largest_fitting_radius_mm(heightfield)
            raise CutterTooLargeError(
                radius_mm=spec.radius_mm,
                reached_share=share,
                largest_mm=largest.everywhere_mm,
                nearly_mm=largest.nearly_mm,
            )


def _layer_share(field: Field, rows: Rows, plan: LayerPlan) -> float:
    """Part of the work that the layers are, by rows."""
    layers = len(plan.layers) * field.rows.y_mm.size
    return layers / (layers + rows.y_mm.size * plan.exact_rows)


def _all_layers(
    field: Field,
    surface: ToolSurface,
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

        yield from layer_paths(field, surface, met, layer, above, spec, safe_z_mm=safe_z_mm, on_progress=on_progress)
        above = layer


def _counting(polylines: Iterator[Array], rows: Rows, report: Progress) -> Iterator[Array]:
    low, high = rows.y_mm[0], rows.y_mm[-1]
    for polyline in polylines:
        yield polyline
        report(float((polyline[-1, 1] - low) / (high - low)))


def _rows_paths(
    polylines: Iterator[Array], met: StockTouch, above: Layer | None, spec: PassSpec, *, safe_z_mm: float
) -> Iterator[Path]:
    """Exact rows: one unbroken path, or each row entered and left by itself."""
    lifts = spec.link == "retract"
    last = np.empty(3)
    for index, polyline in enumerate(polylines):
        if lifts or index == 0:
            if index:
                yield leave(last[0], last[1], safe_z_mm=safe_z_mm)
            start = polyline[0]
            height = met.at(start[0], start[1]) + met.slack_mm
            if above is not None:
                height = min(height, float(above.tips_mm(start[2:])[0]) + CUSP_MM)
            yield from enter(_first_row(polyline), height, spec, safe_z_mm=safe_z_mm)
        yield cut(polyline, spec.feed_mm_per_min)
        last = polyline[-1]
    yield leave(last[0], last[1], safe_z_mm=safe_z_mm)


def _first_row(polyline: Array) -> Array:
    """The straight beginning, up to the first turn: ramps stay on it."""
    return polyline[: len(polyline) if (same := polyline[:, 1] == polyline[0, 1]).all() else int(np.argmin(same))]
