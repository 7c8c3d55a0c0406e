"""Estimates the time of a pass from a sample of the moves of its program: a first pass on a coarse lens, or a few exact
rows (fewer for a quick plan).

`cam.duration` times the moves that `cam.rows` makes and `cam.rows.rounding` puts on the raster of control or mill. The
time of layers depends on entries, walls and turns as much as on rows. The time of exact rows on a slow link depends on
vertices, of which the raster leaves out up to half. A formula for either would be off by a third.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from math import ceil, inf, log, pi
from typing import cast

import numpy as np
from scipy.ndimage import grey_opening

from cam.checking.flat_removal import removal_of
from cam.duration import DurationModel, Kinematics
from cam.materials import SLOT_FEED
from cam.moves import SAFE_Z_MM, Path, cut, rapid
from cam.passes import PassSpec, Stock
from cam.planning.pass_time import LensForm, entry_s, slowness_s_per_mm, turn_s
from cam.posts.post import Digits
from cam.program import layer_paths_alone, pass_paths
from cam.reading.gcode import MoveBatch
from cam.rows.layers import STAIR_SHARE, layer_row_distance_mm, plane_row_distance_mm
from cam.rows.loads import feed_at_load, most_feed_mm_per_min
from cam.rows.raster import on_ticks, turn_lens, turn_parts
from cam.rows.rounding import Rounding, on_raster
from cam.rows.vertices import SLOPE_ERROR_RAD, finish_rule, march_row, most_vertices
from cam.surface.stock_grid import StockGrid
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Array, Heightfield

ROWS, FEW_ROWS = 40, 8  # of a pass that are made: 20 are off by up to 4 %, 8 of a coarse lens by 1 %
_PITCHES_MM = (0.02, 0.05, 0.12, 0.25)  # pitches at which rows are made: in between, vertices are much the same
_FEW_PITCHES_MM = (0.05,)  # pitch at which few rows are made: on a coarse lens pitches differ by less than a hundredth
_LEAST_PLACES = 2  # vertices of the coarse lens in a radius: the time is within a hundredth
_MOST_SAMPLES = 250_000  # of layers that are made: at most half a second, as of 36 layers for R 3 on 100 mm
_BLOCK_CELL_MM = 1.0  # of a flat block; any value works
_LEFT_CELL_MM = 0.25  # of the stock that a first pass leaves
_NODES = 4  # a radius, of the surface under rows that are only timed: a ten-thousandth from that under rows to be cut
_DECIMALS = 5  # as written: points nearer to one another are one
CONTOUR_STRETCH, CONTOUR_JOINTS = 1.12, 65.0  # of one connected path over area by pitch; joints, in pitches a side
_BORDER = 5.0  # sides of the lens: end walls, and rows at the border of a layer
_ENTRIES = 4.0  # of a layer
_FEED_STEPS = 0.95  # of the feed at load, which is rounded down to one of a few


class _Moves:
    """Straight moves as `cam.duration` takes them, a line each, without pauses."""

    def __init__(self, paths: Iterable[Path], start_mm: Array) -> None:
        kept = list(paths)
        points = np.round(np.vstack([start_mm, *(path.points_mm for path in kept)]), _DECIMALS)
        feeds = np.repeat([path.feed_mm_per_min or inf for path in kept], [len(path.points_mm) for path in kept])
        goes = (np.diff(points, axis=0) != 0).any(axis=1)  # others are not written
        self.points_mm = points[np.concatenate([[True], goes])]
        self.feed_mm_per_min = feeds[goes]
        self.is_rapid = np.isinf(self.feed_mm_per_min)
        self.line = np.arange(1, goes.sum() + 1)
        self.pause_s = np.full(self.line.size, -1.0)

    def __len__(self) -> int:
        return len(self.line)


def _seconds_of(paths: Iterable[Path], start_mm: Array, mill: Kinematics) -> float:
    model = DurationModel(mill)
    model.add(_Moves(paths, start_mm))
    return model.seconds


def first_pass_s(
    form: LensForm, spec: PassSpec, mill: Kinematics, digits: Digits | None = None, *, safe_z_mm: float = SAFE_Z_MM
) -> float:
    """Return the seconds of the first pass, which cuts planes one step-down apart out of the block, down to the lens,
    and the exact rows, if any.
    """
    spec = replace(spec, max_rate_mm_per_min=mill.max_rate_mm_per_min)
    if spec.finishes or spec.strategy == "contour":
        return planes_s(form, spec, mill) + rows_s(form, spec, mill, digits)
    if _spacing_mm(form, spec) > spec.radius_mm / _LEAST_PLACES:
        return planes_s(form, spec, mill)  # entries and walls take little of a small ball's time
    return _seconds_of(_first_paths(form, spec, safe_z_mm), np.array([0.0, 0.0, safe_z_mm]), mill)


def layers_after_s(
    form: LensForm, spec: PassSpec, first: PassSpec, mill: Kinematics, *, safe_z_mm: float = SAFE_Z_MM
) -> float:
    """Return the seconds of a pass's layers after a first pass of a flat cutter, which leaves stairs, hollows and a
    step at the rim.
    """
    first = replace(first, max_rate_mm_per_min=mill.max_rate_mm_per_min)
    spec = replace(
        spec, pitch_mm=layer_row_distance_mm(spec), strategy="raster", max_rate_mm_per_min=mill.max_rate_mm_per_min
    )
    return _layers_after_s(form, spec, first, mill, safe_z_mm)


@lru_cache(maxsize=64)
def _layers_after_s(form: LensForm, spec: PassSpec, first: PassSpec, mill: Kinematics, safe_z_mm: float) -> float:
    lens, block = _coarse_job(form, first)
    stock_top = _cut_block(form, first, safe_z_mm)
    paths = list(layer_paths_alone(lens, spec, block, stock_top=stock_top, safe_z_mm=safe_z_mm))
    return _seconds_of(paths, np.array([0.0, 0.0, safe_z_mm]), mill) if paths else 0.0


@lru_cache(maxsize=8)
def _first_paths(form: LensForm, spec: PassSpec, safe_z_mm: float) -> tuple[Path, ...]:
    lens, block = _coarse_job(form, spec)
    top = StockGrid.block(block, _BLOCK_CELL_MM)
    return tuple(pass_paths(lens, spec, block, stock_top=top, safe_z_mm=safe_z_mm))


@lru_cache(maxsize=8)
def _cut_block(form: LensForm, spec: PassSpec, safe_z_mm: float) -> StockGrid:
    _, block = _coarse_job(form, spec)
    grid = removal_of(spec.shape, StockGrid.block(block, _LEFT_CELL_MM), radius_mm=spec.radius_mm)
    moves = _Moves(_first_paths(form, spec, safe_z_mm), np.array([0.0, 0.0, safe_z_mm]))
    grid.cut(cast(MoveBatch, moves))
    return grid.stock()


def _coarse_job(form: LensForm, first: PassSpec) -> tuple[Heightfield, Stock]:
    """Return the lens at the coarsest resolution that its first pass allows, and the smallest block."""
    lens = _coarsen(form.lens, _spacing_mm(form, first))
    block = Stock(
        width_mm=lens.width_mm,
        height_mm=lens.height_mm,
        thickness_mm=form.deepest_mm + first.radius_mm + first.step_down_mm,
        margin_mm=2 * first.radius_mm + _BLOCK_CELL_MM,
    )
    return lens, block


def _spacing_mm(form: LensForm, first: PassSpec) -> float:
    """Return how far apart the samples along the rows of all planes lie, so that they are not more than the limit."""
    rows_mm = form.width_mm * form.height_mm / plane_row_distance_mm(first) * form.deepest_mm / first.step_down_mm
    return rows_mm / _MOST_SAMPLES


def _coarsen(lens: Heightfield, spacing_mm: float) -> Heightfield:
    """Return the lens with vertices at least about this far apart; they determine the points of the layers' turns."""
    if spacing_mm <= min(lens.dx_mm, lens.dy_mm):
        return lens
    across, up = (ceil(side_mm / spacing_mm) for side_mm in (lens.width_mm, lens.height_mm))
    x = np.linspace(0.0, lens.width_mm, across + 1)
    y = np.linspace(0.0, lens.height_mm, up + 1)
    z = lens.spline().jets(*np.meshgrid(lens.x_mm[0] + x, lens.y_mm[0] + y))[0]
    coarse = Heightfield.on_aperture(np.minimum(z, 0.0), width_mm=lens.width_mm, height_mm=lens.height_mm)
    return replace(coarse, rim_mm=lens.rim_mm)


@lru_cache(maxsize=512)
def rows_s(
    form: LensForm, spec: PassSpec, mill: Kinematics, digits: Digits | None = None, *, made_rows: int = ROWS
) -> float:
    """Return the seconds of a pass's exact rows, or of its one connected path.

    digits : raster on which the vertices of a finishing pass are put; None: they stay where they are
    """
    pitches_mm = _FEW_PITCHES_MM if made_rows == FEW_ROWS else _PITCHES_MM
    like = replace(spec, strategy="raster", pitch_mm=min(pitches_mm, key=lambda one: abs(log(one / spec.pitch_mm))))
    if spec.finishes:
        rounding = None if digits is None else Rounding(digits=digits, pitch_mm=like.pitch_mm)
        slowness, turns_s = (
            _sample_s_per_mm(form, like, mill, rounding, made_rows),
            turn_s(spec, mill) - turn_s(like, mill),
        )
    else:  # chords are long, and the feed sets the time
        slowness, turns_s = slowness_s_per_mm(form, spec, mill), turn_s(spec, mill)
    if spec.strategy == "contour":
        stretched = CONTOUR_STRETCH + CONTOUR_JOINTS * spec.pitch_mm / min(form.width_mm, form.height_mm)
        return stretched * form.width_mm * form.height_mm / spec.pitch_mm * slowness
    length_mm, across_mm = _spans_mm(form, spec)
    first = max(slowness, 1 / (SLOT_FEED * spec.feed_mm_per_min / 60))  # with stock on both sides
    return ceil(across_mm / spec.pitch_mm) * (length_mm * slowness + turns_s) + length_mm * first


def _spans_mm(form: LensForm, spec: PassSpec) -> tuple[float, float]:
    """Return the extent of tips along the rows, and across."""
    sides = (form.width_mm + 2 * spec.radius_mm, form.height_mm + 2 * spec.radius_mm)
    return sides if spec.direction == "x" else sides[::-1]


@lru_cache(maxsize=256)
def _sample_s_per_mm(
    form: LensForm, spec: PassSpec, mill: Kinematics, rounding: Rounding | None, made_rows: int
) -> float:
    """Return the time of rows by their length in plan, their turns included."""
    rows = _sample_rows(form, replace(spec, pitch_mm=spec.radius_mm), made_rows)  # the same for all pitches
    paths: Iterable[Path] = _join(rows, spec, 10.0**-_DECIMALS if rounding is None else rounding.digits.z_mm)
    if rounding is not None and rounding.matters:
        paths = on_raster(paths, rounding)
    start, *cuts = paths
    return _seconds_of(cuts, start.points_mm[-1], mill) / (len(rows) * _spans_mm(form, spec)[0])


def _join(rows: tuple[Array, ...], spec: PassSpec, z_mm: float) -> Iterator[Path]:
    """Yield rows (n, 3) in X a pitch apart, there and back, with level turns between them: the height of a row does not
    affect the time, if it is lifted by whole digits z_mm.
    """
    bulge_mm, feed = spec.pitch_mm / 2, spec.feed_mm_per_min
    left, right = rows[0][0, 0] + bulge_mm, rows[0][-1, 0] - bulge_mm
    parts = turn_parts(bulge_mm)
    angles = pi * np.arange(1, parts) / parts
    end = np.zeros(3)
    for number, row in enumerate(rows):
        x = np.concatenate([[left], row[(row[:, 0] > left) & (row[:, 0] < right), 0], [right]])
        line = np.column_stack([x, np.full(x.size, number * spec.pitch_mm), np.interp(x, row[:, 0], row[:, 2])])
        if number % 2:
            line = line[::-1]
        line[:, 2] += z_mm * round((end[2] - line[0, 2]) / z_mm)
        if number:
            out = bulge_mm if number % 2 else -bulge_mm
            turn_y = end[1] + bulge_mm * (1 - np.cos(angles))
            turn = np.column_stack([end[0] + out * np.sin(angles), turn_y, np.full(angles.size, end[2])])
            yield cut(on_ticks(turn), SLOT_FEED * feed)  # into stock that no row has touched
        else:
            yield rapid(line[0])
        yield cut(line if number else line[1:], feed)
        end = line[-1]


@lru_cache(maxsize=32)
def _sample_rows(form: LensForm, spec: PassSpec, made_rows: int) -> tuple[Array, ...]:
    """Return vertices (n, 3) of rows evenly spread over lens and run-out."""
    lens = form.lens if spec.direction == "x" else turn_lens(form.lens)
    rule = finish_rule(SLOPE_ERROR_RAD, min(lens.dx_mm, spec.radius_mm / 2), aperture_x_mm=(0.0, lens.width_mm))
    length_mm, across_mm = _spans_mm(form, spec)
    over = partial(ToolSurface.over, lens, radius_mm=spec.radius_mm, nodes=_NODES)
    whole = None if 3 * spec.radius_mm * made_rows < across_mm else over()

    def make(y: float) -> Array:
        surface = whole or over(row_mm=y)
        out = np.empty((most_vertices(length_mm, rule), 3))
        return out[: march_row(surface.kernel, rule, y, -spec.radius_mm, lens.width_mm + spec.radius_mm, out, 0)].copy()

    return tuple(make(y) for y in on_ticks((np.arange(made_rows) + 0.5) / made_rows * across_mm - spec.radius_mm))


@lru_cache(maxsize=64)
def planes_s(form: LensForm, spec: PassSpec, mill: Kinematics) -> float:
    """Return the approximate seconds of a ball's first pass from the area of each plane: within a fifth.

    In addition to the stock above the lens, each plane costs rows at its border, a path along both end walls, and
    entries.
    """
    tips = form.tips_mm(spec.radius_mm) + spec.stock_to_leave_mm
    sides = (form.width_mm + 2 * spec.radius_mm, form.height_mm + 2 * spec.radius_mm)
    distance_mm = plane_row_distance_mm(spec)
    if not spec.is_ball:
        distance_mm = min(distance_mm, STAIR_SHARE * spec.step_down_mm / max(1e-9, float(form.slopes[-1])))
    distance_mm = spec.pitch_mm * max(1, int(distance_mm / spec.pitch_mm))
    spec = replace(spec, max_rate_mm_per_min=mill.max_rate_mm_per_min)
    feed = _FEED_STEPS * float(feed_at_load(distance_mm * spec.step_down_mm, spec)) / 60
    gap = ceil(2 * spec.radius_mm / (sides[0] / tips.shape[1]))
    beyond = np.pad(tips, ((0, 0), (gap, gap)), constant_values=np.inf)
    crossed = np.sort(grey_opening(beyond, (1, gap)), axis=None)  # rows continue over gaps no wider than the ball
    planes_mm = -spec.step_down_mm * np.arange(ceil(-float(tips.min()) / spec.step_down_mm))
    rows_mm = np.searchsorted(crossed, planes_mm).sum() / tips.size * sides[0] * sides[1] / distance_mm
    slots = SLOT_FEED * spec.feed_mm_per_min / 60
    turns_s = rows_mm / min(sides) * (feed / min(mill.acceleration_mm_per_s2[:2]) + distance_mm / slots)
    between_mm = sides[0] * sides[1] * (1 / spec.pitch_mm - 1 / distance_mm)
    seconds = rows_mm / feed + turns_s + between_mm / (float(most_feed_mm_per_min(spec)) / 60)
    return float(seconds + planes_mm.size * (_BORDER * min(sides) / feed + _ENTRIES * entry_s(spec)))
