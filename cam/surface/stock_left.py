"""Compares the stock after a pass with the lens, cell by cell: gouge, excess, and places that the ball cannot reach."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from cam.passes import PassSpec
from cam.surface.stock_grid import StockGrid
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Array, Heightfield, spline_jet

_JUDGED = 20_000  # most cells whose reach is computed
_NAMED = 8  # places out of reach that are named
_TOUCH_MM = 0.002  # a ball may penetrate the surface elsewhere by this and still count as reaching a place
_PHASES, _ALONG, _ALONG_SHARE = 8, 21, 0.3  # places tried across and along rows; length along, in radii
_BESIDE_A_CREASE = 4.0
"""Cusps that are allowed beside an unreachable place. The ball changes flanks there, and the nearest row that touches
may be a whole pitch away instead of half of one. `cam.checking.path_quality` finds missing rows.
"""


@njit(cache=True, nogil=True)
def _compare(top, x0, y0, cell, coefs, sx0, sy0, inv_dx, inv_dy, width, height, leave, pitch, radius, ball, out):  # type: ignore[no-untyped-def] # fmt: skip
    """Compare. out: stock above the lens plus the stock to leave; stock above the lens; the excess that the theory
    allows over the first.

    All along Z; NaN off the aperture.
    """
    over, lens, cusp = out
    ny, nx = top.shape
    for j in range(ny):
        y = y0 + (j + 0.5) * cell
        for i in range(nx):
            x = x0 + (i + 0.5) * cell
            if x < 0.0 or y < 0.0 or x > width or y > height:
                over[j, i] = math.nan
                lens[j, i] = math.nan
                cusp[j, i] = math.nan
                continue
            h, hx, hy, hxx, hxy, hyy = spline_jet(coefs, sx0, sy0, inv_dx, inv_dy, x, y)
            steep = 1.0 + hx * hx + hy * hy  # 1 / cos^2
            q = math.sqrt(steep)
            lens[j, i] = top[j, i] - h
            over[j, i] = lens[j, i] - leave * q
            bend = 0.5 * (hxx + hyy) + math.hypot(0.5 * (hxx - hyy), hxy)  # most hollow direction; an upper bound
            if bend < 0.0:
                bend /= steep * q
            if not ball:  # stairs from row to row, and in a hollow also the stock that no flat end reaches
                cusp[j, i] = pitch * math.sqrt(steep - 1.0) + 0.25 * radius * radius * max(0.0, bend)
                continue
            # Tips p apart in plan are up to p q apart on the slope; the ridge, p^2 / 8R, stands on the slope (q), and
            # in a hollow the contacts spread to p / (1 - R k). Near 1 - R k = 0 the ball hardly fits, so there is no
            # cusp.
            cusp[j, i] = pitch * pitch * steep * q / (8.0 * radius * max(0.25, 1.0 - (radius + leave) * bend))


@njit(cache=True, nogil=True)
def _deepest_in(coefs, x0, y0, inv_dx, inv_dy, x, y, radius, rings):  # type: ignore[no-untyped-def]
    """Return how far a ball that touches the surface at (x, y) penetrates it elsewhere, run-out included.

    The deepest node of a lattice, then of ever finer 5 x 5 lattices around it.
    """
    h, hx, hy, _hxx, _hxy, _hyy = spline_jet(coefs, x0, y0, inv_dx, inv_dy, x, y)
    q = math.sqrt(1.0 + hx * hx + hy * hy)
    cx = x - radius * hx / q
    cy = y - radius * hy / q
    cz = h + radius / q
    nearest = radius
    deep_x, deep_y = x, y
    step = radius / rings
    for j in range(-rings, rings + 1):
        for i in range(-rings, rings + 1):
            px = cx + i * step
            py = cy + j * step
            flat2 = (px - cx) ** 2 + (py - cy) ** 2
            if flat2 >= radius * radius:
                continue
            hp = spline_jet(coefs, x0, y0, inv_dx, inv_dy, px, py)[0]
            if hp > cz:
                return radius
            away = math.sqrt(flat2 + (hp - cz) ** 2)
            if away < nearest:
                nearest, deep_x, deep_y = away, px, py
    for _ in range(4):
        step *= 0.5
        mid_x, mid_y = deep_x, deep_y
        for j in range(-2, 3):
            for i in range(-2, 3):
                px = mid_x + i * step
                py = mid_y + j * step
                hp = spline_jet(coefs, x0, y0, inv_dx, inv_dy, px, py)[0]
                away = math.sqrt((px - cx) ** 2 + (py - cy) ** 2 + (hp - cz) ** 2)
                if away < nearest:
                    nearest, deep_x, deep_y = away, px, py
    return radius - nearest


@njit(cache=True, nogil=True)
def _fill_reached(coefs, x0, y0, inv_dx, inv_dy, x, y, radius, rings, out):  # type: ignore[no-untyped-def]
    for k in range(x.size):
        out[k] = _deepest_in(coefs, x0, y0, inv_dx, inv_dy, x[k], y[k], radius, rings) <= _TOUCH_MM


@dataclass(frozen=True, slots=True, kw_only=True)
class Unreached:
    """A place that the ball cannot touch: position, height of the stock above what the pass should leave, size."""

    x_mm: float
    y_mm: float
    excess_um: float
    area_mm2: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StockLeft:
    """Stock above the wanted surface (lens plus what the pass leaves along the normal), measured along Z.

    over_mm, cusp_mm (ny, nx) : NaN beyond the aperture; cusp is what pitch, slope and curvature explain
    over_lens_mm (ny, nx)     : stock above the lens itself
    """

    over_mm: Array
    over_lens_mm: Array
    cusp_mm: Array
    grid: StockGrid

    @classmethod
    def of(cls, grid: StockGrid, heightfield: Heightfield, spec: PassSpec) -> StockLeft:
        over, lens, cusp = (np.empty(grid.top_mm.shape) for _ in range(3))
        _compare(
            *(grid.top_mm, grid.x0_mm, grid.y0_mm, grid.cell_mm, *heightfield.spline().kernel_arguments),
            *(heightfield.width_mm, heightfield.height_mm, spec.stock_to_leave_mm, spec.pitch_mm, spec.radius_mm),
            *(spec.is_ball, (over, lens, cusp)),
        )
        return cls(over_mm=over, over_lens_mm=lens, cusp_mm=cusp, grid=grid)

    @property
    def in_aperture(self) -> np.ndarray:
        return np.isfinite(self.over_mm)

    def lowest(self, among: np.ndarray) -> tuple[float, int]:
        """Return (least over_mm, flat cell) among the marked cells; (inf, -1) when there are none."""
        return _least(self.over_mm, among)

    def lowest_over_lens(self, among: np.ndarray) -> tuple[float, int]:
        """Return the same for over_lens_mm: below 0 is a gouge."""
        return _least(self.over_lens_mm, among)

    def suspicious(self, spec: PassSpec) -> np.ndarray:
        """Return cells that stand higher than tracks at the pass's pitch explain."""
        slack_mm = max(0.001, 0.02 * spec.stock_to_leave_mm)
        with np.errstate(invalid="ignore"):
            return np.asarray(self.over_mm > 1.5 * self.cusp_mm + slack_mm)


def _least(values: Array, among: np.ndarray) -> tuple[float, int]:
    marked = np.where(among & np.isfinite(values), values, np.inf)
    cell = int(marked.argmin())
    return (float(marked.flat[cell]), cell) if np.isfinite(marked.flat[cell]) else (math.inf, -1)


def within_reach(cells: np.ndarray, grid: StockGrid, heightfield: Heightfield, spec: PassSpec) -> np.ndarray:
    """Return which of the cells (flat indices) a ball of the pass's radius plus its stock to leave can touch."""
    rows, columns = np.divmod(cells, grid.top_mm.shape[1])
    radius_mm = spec.radius_mm + spec.stock_to_leave_mm
    rings = int(np.clip(radius_mm / (2 * min(heightfield.dx_mm, heightfield.dy_mm)), 12, 24))
    out = np.empty(cells.size, dtype=np.bool_)
    _fill_reached(
        *heightfield.spline_with_run_out(2 * radius_mm).kernel_arguments,
        *(grid.x_mm[columns], grid.y_mm[rows], radius_mm, rings, out),
    )
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class ExcessFound:
    """Excess stock: within the ball's reach (it was not cut) and out of its reach (it cannot be cut).

    excess_um      : greatest height above the wanted surface within reach, cusps included; at x_mm, y_mm
    uncut_mm       : greatest height beyond the allowed cusps among reachable cells under suspicion (0: none)
    """

    excess_um: float
    uncut_mm: float
    x_mm: float
    y_mm: float
    unreached: tuple[Unreached, ...]
    unreached_share: float


def find_excess(
    left: StockLeft, heightfield: Heightfield, spec: PassSpec, among: np.ndarray | None = None
) -> ExcessFound:
    """Separate forgotten stock from stock that the ball cannot reach. among (ny, nx): the cells that are judged.

    A flat cutter leaves too much for this test: instead, the spacing of its rows and the stock of the next pass are
    judged.
    """
    suspects = left.suspicious(spec)
    judged_over_mm = left.over_mm
    if among is not None:
        suspects = suspects & among
        judged_over_mm = np.where(among, left.over_mm, np.nan)
    if not spec.is_ball:
        suspects = np.zeros_like(suspects)
    flat = np.flatnonzero(suspects)
    stride = max(1, -(-flat.size // _JUDGED))
    judged = flat[::stride]
    reach = within_reach(judged, left.grid, heightfield, spec)
    out_of_reach = np.zeros(left.over_mm.shape, dtype=np.bool_)
    out_of_reach.flat[judged[~reach]] = True
    forgotten = judged[reach]
    regular = np.where(suspects, -np.inf, np.nan_to_num(judged_over_mm, nan=-np.inf))
    cell = int(regular.argmax())
    excess_mm, uncut_mm = float(regular.flat[cell]), 0.0
    if forgotten.size:
        uncut_mm, cell = _worst_uncut(forgotten, left, heightfield, spec)
        excess_mm = max(excess_mm, float(left.over_mm.flat[cell]))
    row, column = divmod(cell, left.over_mm.shape[1])
    whole = max(1, int(left.in_aperture.sum()))
    return ExcessFound(
        excess_um=1000 * max(0.0, excess_mm) if math.isfinite(excess_mm) else 0.0,
        uncut_mm=uncut_mm,
        x_mm=float(left.grid.x_mm[column]),
        y_mm=float(left.grid.y_mm[row]),
        unreached=_places(out_of_reach, left, stride),
        unreached_share=float(out_of_reach.sum()) * stride / whole,
    )


def _worst_uncut(cells: np.ndarray, left: StockLeft, heightfield: Heightfield, spec: PassSpec) -> tuple[float, int]:
    """Return the excess of the worst cell over what tracks at the pass's pitch may leave there, and the cell.

    On a rippled lens, rows far apart leave more than cusps, because the ball rests on ridges beside a hollow that it
    would touch between them. If cusps do not explain a cell, all possible positions of the neighbouring rows are tried.
    """
    over_mm = left.over_mm.flat[cells]
    beyond = over_mm - _BESIDE_A_CREASE * left.cusp_mm.flat[cells]
    order = np.argsort(beyond)[::-1]
    worst_mm, worst = 0.0, int(cells[order[0]])
    if spec.strategy != "raster" or beyond[order[0]] <= 0.0:
        return max(0.0, float(beyond[order[0]])), worst
    tips = ToolSurface.over(heightfield, radius_mm=spec.radius_mm, allowance_mm=spec.stock_to_leave_mm)
    for k in order:
        if beyond[k] <= worst_mm:
            break
        uncut_mm = min(float(beyond[k]), float(over_mm[k]) - _measure_left_by_rows(int(cells[k]), left, tips, spec))
        if uncut_mm > worst_mm:
            worst_mm, worst = uncut_mm, int(cells[k])
    return worst_mm, worst


def _measure_left_by_rows(cell: int, left: StockLeft, tips: ToolSurface, spec: PassSpec) -> float:
    """Return the most stock (over_mm) that two rows a pitch apart, one on either side of the place, leave there."""
    row, column = divmod(cell, left.over_mm.shape[1])
    at = np.array([left.grid.x_mm[column], left.grid.y_mm[row]])
    wanted_mm = float(left.grid.top_mm.flat[cell] - left.over_mm.flat[cell])
    contact = tips.contacts_mm(at[:1], at[1:])[0]  # of the ball straight above: near the one that touches the place
    aside = np.linspace(-1.0, 1.0, 2 * _PHASES + 1) * spec.pitch_mm
    along = np.linspace(-1.0, 1.0, _ALONG) * max(spec.pitch_mm, _ALONG_SHARE * spec.radius_mm)
    middle = 2 * at - contact[:2]  # equally far on the other side: position of the ball that touches the place
    lengthwise = 0 if spec.direction == "x" else 1
    places = np.empty((aside.size, along.size, 2))
    places[..., lengthwise] = middle[lengthwise] + along
    places[..., 1 - lengthwise] = middle[1 - lengthwise] + aside[:, None]
    centre_mm = tips.tip_heights_mm(places[..., 0], places[..., 1]).reshape(places.shape[:2]) + spec.radius_mm
    below = spec.radius_mm**2 - np.square(places - at).sum(axis=-1)
    lowest = np.where(below >= 0, centre_mm - np.sqrt(np.maximum(below, 0.0)), np.inf).min(axis=1)
    return float(np.minimum(lowest[:-_PHASES], lowest[_PHASES:]).max()) - wanted_mm


def _places(out_of_reach: np.ndarray, left: StockLeft, stride: int) -> tuple[Unreached, ...]:
    """Return the largest excesses out of reach, one per connected spot (cells up to two apart belong together)."""
    if not out_of_reach.any():
        return ()
    near = ndimage.binary_dilation(out_of_reach, iterations=1 + min(stride, 3))
    spots, count = ndimage.label(near, structure=np.ones((3, 3)))
    cells = np.flatnonzero(out_of_reach)
    spot, over_mm = spots.flat[cells] - 1, left.over_mm.flat[cells]
    order = np.lexsort((over_mm, spot))
    highest = order[np.flatnonzero(np.diff(spot[order], append=count))]
    sizes = np.bincount(spot, minlength=count) * stride * left.grid.cell_mm**2
    worst = np.argsort(over_mm[highest])[::-1][:_NAMED]
    rows, columns = np.divmod(cells[highest], out_of_reach.shape[1])
    return tuple(
        Unreached(
            x_mm=float(left.grid.x_mm[columns[k]]),
            y_mm=float(left.grid.y_mm[rows[k]]),
            excess_um=1000 * float(over_mm[highest[k]]),
            area_mm2=float(sizes[k]),
        )
        for k in worst
    )
