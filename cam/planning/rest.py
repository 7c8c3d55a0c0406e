"""Plans rest passes: the stock that a finishing ball leaves in valleys too narrow for it, the small ball that removes
it, its pitch, and its time.

They are predicted as `cam.rows.rest` will cut them, but from the lens alone: stock remains where the ball bridges a
valley.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import ceil

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from cam.duration import Kinematics
from cam.passes import Direction, PassSpec
from cam.planning.pass_time import LensForm, entry_s, layers_where_s, slowness_s_per_mm, turn_s
from cam.planning.row_slopes import RowSlopes
from cam.planning.shop import Shop, find_exclusion, pitches_mm
from cam.rows.rest import BLEND_MM, CUSPS, LEAST_MM
from cam.tools import Tool, tool_pass
from optics.heightfield import Array, Heightfield

Mask = npt.NDArray[np.bool_]

_REACHES, _HELPS = 0.1, 0.5
"""Shares of the area left by the big ball that the small one may leave: to count as reaching all, or at least as
useful.
"""

_MEDIAN_CUSP = 1 / 4  # of its height
_MOST_PLACES = 20_000  # whose curvature decides how fast the rows run


@dataclass(frozen=True, kw_only=True, eq=False)
class Filled:
    """Stock that a ball leaves in the valleys that it cannot enter.

    over_mm (ny, nx) : stock above the lens at its vertices, cusps not counted
    """

    lens: Heightfield
    over_mm: Array

    def core(self, cusp_mm: float = 0.0) -> Mask:
        """Return where there is more stock than regular cusps explain."""
        return np.asarray(self.over_mm > LEAST_MM + CUSPS * _MEDIAN_CUSP * cusp_mm)

    @cached_property
    def share(self) -> float:
        """Share of the lens's area."""
        return float(self.core().mean())

    def within(self, reach_mm: float, cusp_mm: float = 0.0) -> Mask:
        """Return (ny, nx) whether a vertex is within that distance of the core."""
        core = self.core(cusp_mm)
        if not core.any():
            return core
        return np.asarray(
            ndimage.distance_transform_edt(~core, sampling=(self.lens.dy_mm, self.lens.dx_mm)) <= reach_mm
        )

    def form_near(self, form: LensForm) -> LensForm:
        """Return the lens's form sampled only in and beside the core, evenly thinned."""
        rows, columns = np.nonzero(self.within(BLEND_MM))
        every = slice(None, None, ceil(rows.size / _MOST_PLACES))
        return form.among(self.lens.x_mm[columns[every]], self.lens.y_mm[rows[every]])

    @cached_property
    def cells(self) -> Mask:
        """(ny - 1, nx - 1) cells whose surface a rest pass makes: to the middle of the band in which it runs out."""
        near = self.within(BLEND_MM / 2)
        return np.asarray(near[1:, 1:] & near[:-1, 1:] & near[1:, :-1] & near[:-1, :-1])


@dataclass(frozen=True, slots=True, kw_only=True)
class RestExtent:
    """area_mm2, length_mm: of the region of the tips, including the band around it; regions are entered one by one."""

    area_mm2: float
    length_mm: float
    regions: int
    seconds: float

    @classmethod
    def of(cls, filled: Filled, form: LensForm, spec: PassSpec, mill: Kinematics) -> RestExtent:
        """Measure the rest pass for that stock; form: of the whole lens."""
        near = filled.within(_reach_mm(form, spec), spec.pitch_mm**2 / (8 * spec.radius_mm))
        if not near.any():
            return cls(area_mm2=0.0, length_mm=0.0, regions=0, seconds=0.0)
        area_mm2 = float(near.mean()) * form.width_mm * form.height_mm
        regions, length_mm = int(ndimage.label(near, structure=np.ones((3, 3)))[1]), area_mm2 / spec.pitch_mm
        seconds = length_mm * slowness_s_per_mm(filled.form_near(form), spec, mill) + regions * entry_s(spec)
        seconds += _turns(filled.lens, near, spec) * turn_s(spec, mill)
        seconds += layers_where_s(form, spec, filled.over_mm, mill)
        return cls(area_mm2=area_mm2, length_mm=length_mm, regions=regions, seconds=seconds)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RestPass:
    """A rest pass as planned, and the slope errors that its rows leave."""

    tool: Tool
    spec: PassSpec
    slopes: RowSlopes
    extent: RestExtent


class RestWork:
    """Rest passes after the finishing passes of one ball.

    fillings : by radius, of balls that do not fit the lens everywhere
    """

    def __init__(self, tool: Tool, *, form: LensForm, shop: Shop, fillings: Mapping[float, Filled]) -> None:
        self._form, self._shop = form, shop
        self._filled = fillings.get(tool.radius_mm)
        self._smaller = None if self._filled is None else _choose_smaller(tool, self._filled, form, shop, fillings)
        self._known: dict[tuple[Direction, float], RestPass] = {}

    def plan_after(self, finish: PassSpec) -> RestPass | None:
        """Plan the rest pass; None if nothing is left or no tool of the shop reaches it."""
        if self._filled is None or self._smaller is None:
            return None
        direction: Direction = finish.direction if finish.strategy == "raster" else "x"
        key = (direction, _pitch_mm(self._smaller, finish))
        if key not in self._known:
            self._known[key] = self._plan_pass(self._smaller, self._filled, *key)
        return self._known[key]

    def _plan_pass(self, tool: Tool, filled: Filled, direction: Direction, pitch_mm: float) -> RestPass:
        near = filled.form_near(self._form)
        spec = _make_spec(tool, self._shop, pitch_mm, direction, near)
        return RestPass(
            tool=tool,
            spec=spec,
            slopes=self._shop.slopes(near, spec),
            extent=RestExtent.of(filled, self._form, spec, self._shop.mill),
        )


def _choose_smaller(
    big: Tool, left: Filled, form: LensForm, shop: Shop, fillings: Mapping[float, Filled]
) -> Tool | None:
    """Return the largest ball that reaches all the stock that the big one leaves, or else the one that reaches most;
    None if none is useful.
    """
    if left.share == 0:
        return None
    shares = {
        tool: fillings[tool.radius_mm].share / left.share if tool.radius_mm in fillings else 0.0
        for tool in shop.balls
        if tool.radius_mm < big.radius_mm and pitches_mm(tool) and find_exclusion(tool, form, shop) is None
    }
    reaching = [tool for tool, share in shares.items() if share <= _REACHES]
    if reaching:
        return max(reaching, key=lambda tool: tool.radius_mm)
    best = min(shares, key=lambda tool: (shares[tool], -tool.radius_mm), default=None)
    return best if best is not None and shares[best] <= _HELPS else None


def _pitch_mm(tool: Tool, finish: PassSpec) -> float:
    """Return the pitch at which this ball's scallops are as steep as those of the finish."""
    allowed = finish.pitch_mm * tool.radius_mm / finish.radius_mm
    return max((pitch for pitch in pitches_mm(tool) if pitch <= allowed + 1e-9), default=pitches_mm(tool)[0])


def _make_spec(tool: Tool, shop: Shop, pitch_mm: float, direction: Direction, near: LensForm) -> PassSpec:
    step_down_mm = shop.finish_step_down_mm(tool)
    asked = partial(
        tool_pass, "rest", tool, pitch_mm=pitch_mm, leaves_mm=0.0, step_down_mm=step_down_mm, direction=direction
    )
    like = asked(shop.speeds(tool, finishes=True))
    return replace(asked(shop.speeds(tool, finishes=True, like=(near, like))), where="rest")


def _reach_mm(form: LensForm, spec: PassSpec) -> float:
    """Return how far beyond the remaining stock tips go: from contact to tip, one row more, and the band."""
    steepest = float(form.slopes[-1])
    lean_mm = spec.radius_mm * steepest / float(np.hypot(1.0, steepest))
    return lean_mm + spec.pitch_mm + max(BLEND_MM, 2 * spec.radius_mm)


def _turns(lens: Heightfield, near: Mask, spec: PassSpec) -> float:
    """Return the number of row ends, estimated from the rows of vertices."""
    along, spacing_mm = (near, lens.dy_mm) if spec.direction == "x" else (near.T, lens.dx_mm)
    starts = along[:, 0].sum() + (along[:, 1:] & ~along[:, :-1]).sum()
    return float(starts) * spacing_mm / spec.pitch_mm
