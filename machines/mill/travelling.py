"""Ways at a safe height: to the work zero, and around the outline of the program that waits on the mill.

The tool first goes up, then across, and down only where the person has asked for the zero of Z. A way is refused where
the position is not sure, where a zero is not known, or where a place on it lies outside the travel; the driver ends it
with the first leg that does not arrive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from machines.driver import Leg, Travel, Triple
from machines.errors import NotAllowedError
from machines.grbl.settings import ControllerSettings
from machines.mill.link import get_settings
from machines.mill.view import MillContext
from machines.preflight.preflight import Bounds, Preflight, work_zero_mm
from machines.runs import RunState
from phrases.phrase import Phrase

DOWN_MM_PER_MIN = 100.0  # at most, towards the block
_ROUNDING_MM = 0.004  # of two reports of an offset, in mm or in inch
_SMALL_MM = 0.0005  # half a digit of a report
_FRAMES = ("G54", "G55", "G56", "G57", "G58", "G59")


@dataclass(eq=False)
class WayPlanner:
    """Plans ways from where the tool is now. Sends nothing.

    safe_z_mm : work Z at which the tool goes across, of the profile
    """

    context: MillContext
    safe_z_mm: float

    def to_zero(self, axes: str, feed_mm_per_min: float) -> Travel:
        """Return the way to X0 Y0 at a safe height, and with axes = "XYZ" down to Z0 there. NotAllowedError."""
        name = Phrase("Go to zero of {axes}", axes="X and Y" if axes == "XY" else "X, Y and Z")
        at_mm, zero_mm = self._find_place(name)
        x_mm, y_mm, z_mm = zero_mm
        height_mm = max(at_mm[2], z_mm + self.safe_z_mm)
        legs = _go_across(at_mm, [(x_mm, y_mm)], height_mm, feed_mm_per_min)
        if axes == "XYZ":
            if self.context.link.status.spindle_on is not False:
                raise NotAllowedError(Phrase("{name}: the spindle must be off to go down to the block", name=name))
            legs.append(Leg((x_mm, y_mm, z_mm), min(feed_mm_per_min, DOWN_MM_PER_MIN)))
        return Travel(name=name, legs=tuple(legs))

    def around(self, program: str, feed_mm_per_min: float, *, confirmed: bool = False) -> Travel:
        """Return the way around the outline of the parked program, above all of it. NotAllowedError.

        program   : digest of the program that the person has seen; of a dry pass the one it is made from, too
        confirmed : a person at the mill has just said that position and zero are right
        """
        run = next((run for run in self.context.runs.views() if run.state is RunState.PARKED), None)
        if run is None or program not in (run.program, run.lifted_from):
            raise NotAllowedError(Phrase("Frame: this program does not wait on the mill; load it again"))
        name = Phrase("Frame of {program}", program=run.name)
        at_mm, zero_mm = self._find_place(name, confirmed=confirmed)
        facts, _ = self.context.runs.get(run.id).load()
        box = self._find_box(facts, name)
        (left, front, _), (right, back, top) = box.least_mm, box.most_mm
        if left is None or front is None or right is None or back is None or top is None:
            raise NotAllowedError(Phrase("{name}: the program does not say where it goes", name=name))
        height_mm = max(at_mm[2], zero_mm[2] + max(self.safe_z_mm, top))
        corners = [(left, front), (right, front), (right, back), (left, back), (left, front)]
        points = [(zero_mm[0] + x, zero_mm[1] + y) for x, y in corners]
        return Travel(name=name, legs=tuple(_go_across(at_mm, points, height_mm, feed_mm_per_min)))

    def _find_place(self, name: Phrase, *, confirmed: bool = False) -> tuple[Triple, Triple]:
        """Return where the tool is and where the work zero is, in machine coordinates."""
        status, setup = self.context.link.status, self.context.link.setup
        settings = get_settings(self.context.link.driver)
        at_mm, seen_mm = status.machine_mm, status.work_offset_mm
        zero_mm = None if settings is None else work_zero_mm(settings.offsets, _find_active_frame(settings))
        if at_mm is None or zero_mm is None:
            raise NotAllowedError(Phrase("{name}: the mill does not report its position", name=name))
        if seen_mm is None or any(abs(a - b) > _ROUNDING_MM for a, b in zip(seen_mm, zero_mm, strict=True)):
            raise NotAllowedError(
                Phrase("{name}: the mill has not reported this work zero yet; wait a second", name=name)
            )
        if confirmed:
            return at_mm, zero_mm
        if not status.position_trusted:
            raise NotAllowedError(
                Phrase("{name}: the position of the mill is not certain; home it, or set the zero again", name=name)
            )
        unknown = [axis for axis, mm in zip("XYZ", zero_mm, strict=True) if axis not in setup.zeroed and _is_none(mm)]
        if unknown:
            raise NotAllowedError(
                Phrase("{name}: the work zero of {axes} is not set", name=name, axes=", ".join(unknown))
            )
        return at_mm, zero_mm

    def _find_box(self, facts: Preflight, name: Phrase) -> Bounds:
        """Return the program's box, if it works in the coordinate system that is active now."""
        frames = [frame for frame in facts.bounds_by_frame if frame != "machine"]
        now = _find_active_frame(get_settings(self.context.link.driver))
        if len(frames) != 1 or frames[0] != now:
            raise NotAllowedError(
                Phrase(
                    "{name}: the program works in {frames}, the controller is in {now}: send the one that it uses",
                    name=name,
                    frames=", ".join(frames) or "G53",
                    now=now or Phrase("an unknown one"),
                )
            )
        return facts.bounds_by_frame[now]


def _go_across(
    at_mm: Triple, points_mm: Sequence[tuple[float, float]], height_mm: float, feed_mm_per_min: float
) -> list[Leg]:
    """Return the legs up to the height and then from point to point; a leg of no length is left out."""
    x_mm, y_mm, z_mm = at_mm
    legs = [Leg((x_mm, y_mm, height_mm), feed_mm_per_min)] if height_mm > z_mm + _SMALL_MM else []
    for point in points_mm:
        if max(abs(point[0] - x_mm), abs(point[1] - y_mm)) > _SMALL_MM:
            legs.append(Leg((*point, height_mm), feed_mm_per_min))
        x_mm, y_mm = point
    return legs


def _is_none(offset_mm: float) -> bool:
    """Return whether this offset is that of a controller on which nobody has set a zero."""
    return abs(offset_mm) <= _SMALL_MM


def _find_active_frame(settings: ControllerSettings | None) -> str:
    words = settings.parser_state.split() if settings is not None else []
    return next((word for word in words if word in _FRAMES), "")
