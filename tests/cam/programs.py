"""Whole programs, paths and plans in one call, as tests want them: the product works on parts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from typing import Any

from cam.as_milled.rows import make_rule, make_tracks
from cam.as_milled.tracks import Tracks
from cam.checking.clearance import SurfaceWitness
from cam.checking.path_quality import PathMeasures, PathQuality
from cam.passes import Direction, PassSpec, Stock, ball_pass
from cam.planning.pass_time import LensForm
from cam.planning.planner import Goal, Light, Plan, find_candidates, plan_among
from cam.planning.rest import Filled
from cam.planning.shop import Shop
from cam.program import generate_parts
from cam.reading.gcode import MoveBatch, read_parts
from cam.reading.gcode_languages import GRBL, Language
from cam.rows.raster import Rows, turn_lens
from cam.rows.vertices import SLOPE_ERROR_RAD
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield


def generate_program(heightfield: Heightfield, spec: PassSpec, stock: Stock, **options: Any) -> Iterator[bytes]:
    """Return the pass as one program, in pieces."""
    return chain.from_iterable(generate_parts(heightfield, spec, stock, **options))


def read_program(chunks: Iterable[bytes], language: Language = GRBL) -> Iterator[MoveBatch]:
    """Yield the moves of one program."""
    yield from read_parts([chunks], language)


def measure_program(batches: Iterable[MoveBatch], heightfield: Heightfield, spec: PassSpec) -> PathMeasures:
    """Return the measures of a whole program."""
    quality = PathQuality(heightfield, spec)
    witness = SurfaceWitness(heightfield, radius_mm=spec.radius_mm, near_mm=quality.near_mm)
    for batch in batches:
        quality.add(batch, witness.overlaps(batch))
    return quality.measure()


def row_tracks(
    heightfield: Heightfield,
    *,
    radius_mm: float,
    pitch_mm: float,
    direction: Direction = "x",
    decimals: int = 5,
    slope_error_rad: float = SLOPE_ERROR_RAD,
) -> Tracks:
    """Return rows of one ball all over the lens, joined by turns on the surface, z rounded as a program rounds it."""
    lens = heightfield if direction == "x" else turn_lens(heightfield)
    stock = Stock(width_mm=lens.width_mm, height_mm=lens.height_mm, thickness_mm=1.0, margin_mm=0.0)
    spec = ball_pass("rows", radius_mm=radius_mm, pitch_mm=pitch_mm, stock_to_leave_mm=0.0, step_down_mm=radius_mm)
    surface, rule = ToolSurface.over(lens, radius_mm=radius_mm), make_rule(lens, radius_mm, slope_error_rad)
    return make_tracks(surface, Rows.over(stock, spec), rule, direction, decimals)


def make_plan(
    shop: Shop, lenses: Mapping[float, LensForm], light: Light, goal: Goal, *, fillings: Mapping[float, Filled]
) -> Plan:
    """Choose among all candidates."""
    candidates, left_out = find_candidates(shop, lenses, light, fillings=fillings)
    return plan_among(candidates, left_out, light, goal, shop=shop, lenses=lambda: lenses)
