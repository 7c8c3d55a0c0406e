"""A plan, the light model that it was made with, and the values that it gives to the job spec."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

from cam.planning.planner import Candidate, Goal, Plan
from cam.tools import Tool
from machines.profile import MachineProfile
from optics.heightfield import Array
from optics.metrics import CausticScore
from optics.polish import Polished
from service.job.planning.finish_choice import Finishing
from service.job.planning.predicted_light import PictureLight
from service.job.planning.rim_room import RimRoom
from service.job.spec.finish import NONE
from service.job.spec.model import PassRow


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A plan with the light model it was made with."""

    plan: Plan
    light: PictureLight
    machine: MachineProfile
    goal: Goal
    shapes_lens: bool  # whether the lens is shaped for the chosen ball
    tools: tuple[Tool, ...]
    finishing: Finishing | None = None  # the finish by hand after milling
    unfinished: Plan | None = None  # the best plan without that finish
    rim_room: RimRoom | None = None  # left by the passes for the tool of that finish
    polished: Polished | None = None  # the lens for that finish, if one as fine as the target was designed

    @cached_property
    def radius_of(self) -> dict[str, float]:
        return {tool.name: tool.radius_mm for tool in self.tools}

    @property
    def chosen(self) -> Candidate:
        return self.plan.chosen

    @property
    def choices(self) -> list[Candidate]:
        """Return the quickest, the chosen and the best candidate, each once, quickest first."""
        wanted = (self.plan.quickest, self.chosen, self.plan.best)
        return [one for one in self.plan.front if one in wanted]

    def picture(self, candidate: Candidate) -> Array:
        """Return the predicted light (ny, nx) on the screen of a candidate of the plan's front, work frame."""
        return self._pictures[self.plan.front.index(candidate)]

    @cached_property
    def _pictures(self) -> tuple[Array, ...]:
        return tuple(self.light.picture(one.marks) for one in self.plan.front)

    @cached_property
    def _scores(self) -> tuple[CausticScore, ...]:
        return tuple(map(self.light.score, self._pictures))

    def score(self, candidate: Candidate) -> CausticScore:
        """Return PSNR, SSIM and the other scores of the predicted light of a candidate of the plan's front."""
        return self._scores[self.plan.front.index(candidate)]

    def foreseen_blur_mm(self, candidate: Candidate | None = None) -> list[float]:
        """Return the blur for which the lens is to be sharpened, to the micrometre."""
        return [round(value, 3) for value in self.light.foreseen_blur_mm((candidate or self.chosen).marks)]

    def blur_px(self, candidate: Candidate) -> float:
        return candidate.blur_mm / min(self.light.pixel_mm)

    def rows(self, candidate: Candidate | None = None) -> list[dict[str, Any]]:
        """Return the passes in the form of the job spec."""
        passes = (candidate or self.chosen).passes
        rows = [{key: value for key, value in asdict(spec).items() if key in PassRow.model_fields} for spec in passes]
        return [{key: value for key, value in row.items() if value is not None} for row in rows]

    def settings(self) -> dict[str, Any]:
        """Return the values of the plan from which lens and programs are made: see `spec.resolve.with_plan`."""
        return {
            "passes": self.rows(),
            "branch": self.light.bench.branch,
            "min_radius_mm": self.chosen.marks.smallest_mm,
            "foreseen_blur_mm": self.foreseen_blur_mm(),
            "whole_steps": self.machine.whole_steps,
            "finish": self.finish_table(),
        }

    def fragment(self, candidate: Candidate | None = None) -> dict[str, Any]:
        """Return the values that turn the job's spec into this plan if merged into it, section by section."""
        one = candidate or self.chosen
        optics: dict[str, Any] = {"branch": self.light.bench.branch}
        if self.shapes_lens:
            optics["min_radius_mm"] = one.finish.radius_mm
        if any(blur_mm := self.foreseen_blur_mm(one)):
            optics["foreseen_blur_mm"] = blur_mm
        machine = {"whole_steps": True} if self.machine.whole_steps else {}
        return {"passes": self.rows(one), "optics": optics, "machine": machine, "finish": self.finish_table()}

    def finish_table(self) -> dict[str, Any]:
        """Return the finish in the form of the job spec."""
        if (chosen := self.finishing) is None:
            return {"process": NONE}
        table = {
            "process": chosen.process,
            "k0_rad_per_mm": chosen.finish.k0_rad_per_mm,
            "order": chosen.finish.order,
            "depth_um": chosen.depth_um,
            "minutes": chosen.minutes,
            "pad_mm": chosen.finish.pad_mm,
        }
        return {key: value for key, value in table.items() if value is not None}

    def rest_gain_db(self, one: Candidate) -> float:
        """Return the gain of the rest pass [dB]; 0 without one."""
        if one.rest is None:
            return 0.0
        return one.psnr_db - self.light.aimed_db(replace(one.marks, rest=None))
