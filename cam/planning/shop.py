"""The means for milling: a shop's tools, its material and its mill; and the marks of its rows on a lens."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from cam.checking.envelope import Envelope, Reach
from cam.duration import Kinematics
from cam.materials import Material, limit_step_down_mm
from cam.moves import SAFE_Z_MM
from cam.passes import PassSpec, Strategy
from cam.planning.pass_time import LensForm, reached_mm_per_min
from cam.planning.row_slopes import RowSlopes, row_slopes
from cam.posts.post import Digits
from cam.tools import Speeds, Tool
from phrases.phrase import Phrase

CLEAR_MM = 1.0
"""Width of the margin that must stay beside the area that a ball clears."""

PITCHES_MM = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.12, 0.14, 0.17, 0.2, 0.24, 0.28, 0.34, 0.4, 0.56, 0.8)
PITCH_SHARE = 1 / 8
"""Greatest share of the radius for a finishing pass."""

_SPARE_MM = 0.3  # the lens that is milled may reach so much deeper than the one that plans are made with
_SLOW_FEED = 0.3
_FINISH_STEP_DOWN_MM, _FINISH_STEP_DOWN_SHARE = 0.5, 1 / 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Shop:
    """Tools, material and mill.

    spindle_rpm       : slowest and fastest of the mill
    step_mm, noise_mm : smallest move of its axes; sigma of the height error from row to row
    whole_steps       : vertices of finishing passes are placed where the path crosses whole steps
    margin_mm         : of the block around the lens
    room_mm           : room that the mill's travel leaves around the lens
    envelope          : block and clamps under the mill's head, for how far tools must stick out; None: not considered
    strategies        : allowed for finishing passes
    collet_mm         : the thickest shank that the spindle takes
    removal_mm3_per_min : largest removal rate of spindle and frame
    digits            : raster for the vertices of finishing passes; None: none coarser than that of the path
    safe_z_mm         : height from which tools come down
    """

    tools: tuple[Tool, ...]
    material: Material
    mill: Kinematics
    spindle_rpm: tuple[float, float]
    step_mm: float
    noise_mm: float
    margin_mm: float
    whole_steps: bool = False
    strategies: tuple[Strategy, ...] = ("raster",)
    collet_mm: float = inf
    removal_mm3_per_min: float = inf
    digits: Digits | None = None
    safe_z_mm: float = SAFE_Z_MM
    room_mm: float = inf
    envelope: Envelope | None = None

    @property
    def balls(self) -> tuple[Tool, ...]:
        """The tools that can finish."""
        return tuple(tool for tool in self.tools if tool.is_ball)

    def speeds(self, tool: Tool, *, finishes: bool = False, like: tuple[LensForm, PassSpec] | None = None) -> Speeds:
        """Return speeds and feeds of a tool. like : a lens and a pass over it, whose moves link and look-ahead limit"""
        carried = reached = inf
        if like is not None:
            form, spec = like
            carried = 60 * self.mill.lines_per_s * form.usual_chord_mm(spec)
            reached = reached_mm_per_min(form, spec, self.mill)
        return Speeds.of(
            tool,
            self.material,
            spindle_rpm=self.spindle_rpm,
            max_rate_mm_per_min=self.mill.max_rate_mm_per_min,
            finishes=finishes,
            carried_mm_per_min=carried,
            reached_mm_per_min=reached,
        )

    def cuts_chips(self, tool: Tool) -> bool:
        """Return whether the spindle turns slowly enough for a roughing pass to make chips, even at 0.3 of the feed;
        only 3 % of the time is slower than that.
        """
        speeds = self.speeds(tool)
        return _SLOW_FEED * speeds.feed_mm_per_min >= speeds.chip_mm[0] * tool.flutes * speeds.spindle_rpm

    def holds(self, tool: Tool) -> bool:
        """Return whether the collet takes the tool's shank."""
        return 2 * tool.shank_radius_mm <= self.collet_mm

    def has_room_for(self, tool: Tool) -> bool:
        """Return whether block and travel leave the tool room around the lens."""
        return 2 * tool.radius_mm + CLEAR_MM <= self.margin_mm and tool.radius_mm <= self.room_mm

    def least_stick_out_mm(self, tool: Tool, form: LensForm) -> float:
        """Return how far the tool must stick out to cover the lens and its run-out."""
        if self.envelope is None:
            return form.deepest_mm
        reach = Reach(
            radius_mm=tool.radius_mm,
            shank_radius_mm=tool.shank_radius_mm,
            beyond_mm=(tool.radius_mm, tool.radius_mm),
            lowest_mm=form.lowest_tip_mm(tool.radius_mm) - _SPARE_MM,
            flute_length_mm=tool.flute_length_mm,
        )
        return self.envelope.least_stick_out_mm(reach)

    def layer_step_down_mm(self, tool: Tool, pitch_mm: float) -> float:
        """Return the material's step-down, limited by the mill's removal rate in rows at the tool's feed."""
        speeds = self.speeds(tool)
        return limit_step_down_mm(
            speeds.step_down_mm, pitch_mm, speeds.feed_mm_per_min, removal_mm3_per_min=self.removal_mm3_per_min
        )

    def finish_step_down_mm(self, tool: Tool) -> float:
        """Return the most stock that one move of a finishing pass may take off."""
        share = _FINISH_STEP_DOWN_SHARE * self.speeds(tool).step_down_mm
        return round(min(_FINISH_STEP_DOWN_MM, share), 3)

    def slopes(self, form: LensForm, spec: PassSpec) -> RowSlopes:
        """Return the slope errors that the rows of a finishing pass leave on a lens of that form."""
        return row_slopes(
            radius_mm=spec.radius_mm,
            pitch_mm=spec.pitch_mm,
            step_mm=self.step_mm,
            noise_mm=self.noise_mm,
            vertex_mm=form.usual_chord_mm(spec),
            whole_steps=self.whole_steps,
            steepness=form.steepness(spec),
            tooth_rad=form.tooth_slopes_rad(spec, self.step_mm),
        )


def find_unheld(tool: Tool, shop: Shop) -> Phrase | None:
    """Return why the spindle cannot take a tool, as a clause; None if it can."""
    if shop.holds(tool):
        return None
    return Phrase(
        "it has a shank of {diameter_mm:g} mm; the mill's collet takes {collet_mm:g} mm",
        diameter_mm=2 * tool.shank_radius_mm,
        collet_mm=shop.collet_mm,
    )


def pitches_mm(tool: Tool) -> tuple[float, ...]:
    """Return the pitches of finishing passes with that ball, closest first."""
    return tuple(pitch for pitch in PITCHES_MM if pitch <= PITCH_SHARE * tool.radius_mm)


def find_exclusion(tool: Tool, form: LensForm, shop: Shop) -> Phrase | None:
    """Return why a tool cannot cover a lens, as a clause. Whether its ball fits the hollows is checked elsewhere."""
    if (unheld := find_unheld(tool, shop)) is not None:
        return unheld
    if 2 * tool.radius_mm + CLEAR_MM > shop.margin_mm:
        return Phrase(
            "it clears {diameter_mm:g} mm around the lens; that needs stock.margin_mm = {need_mm:g}",
            diameter_mm=2 * tool.radius_mm,
            need_mm=2 * tool.radius_mm + CLEAR_MM,
        )
    if tool.radius_mm > shop.room_mm:
        return Phrase(
            "it goes {radius_mm:g} mm beyond the lens on either side; the mill's travel leaves {room_mm:g} mm",
            radius_mm=tool.radius_mm,
            room_mm=shop.room_mm,
        )
    steepest = float(form.slopes[-1])
    if tool.shank_radius_mm > tool.radius_mm and steepest * tool.shank_radius_mm > tool.flute_length_mm:
        return Phrase("its shank would touch slopes of {slope:.2g}", slope=steepest)
    if (need_mm := shop.least_stick_out_mm(tool, form)) > tool.stick_out_mm:
        return Phrase(
            "it sticks out {stick_out_mm:g} mm; the lens is {depth_mm:.1f} mm deep and needs {need_mm:.1f} mm under "
            "the collet",
            stick_out_mm=tool.stick_out_mm,
            depth_mm=form.deepest_mm,
            need_mm=need_mm,
        )
    return None
