"""The table `[finish]` of the job spec: how the lens is finished by hand after milling, and its transfer function.

A process of the library fills in missing values; a person's own figures, measured with the coupon, take precedence.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.spec.finish_library import (
    DEPTH_RANGE_UM,
    LEAST_K0_RAD_PER_MM,
    LEAST_PAD_MM,
    LONGEST_PAD_MM,
    ORDER_RANGE,
    Process,
    built_in_processes,
    load_processes,
)
from service.job.spec.section import Section, none_or_from, shown, unknown_name

NONE, BEST = "none", "best"
_WHAT_IT_TAKES = (
    "Takes the mill's marks off: an hour or two on a lens of 100 mm, minutes on a small one. The lens is made for it; "
    "minutes and steps are on the sheet."
)
_PROCESSES = {
    NONE: "no: as the mill leaves it",
    **{
        name: (words, _WHAT_IT_TAKES)
        for name, words in [
            (BEST, "yes, in the best way"),
            *((process.name, process.offered) for process in built_in_processes().values() if process.offered),
        ]
    },
}


class FinishSpec(Section):
    """process: "none", a name of the finish library, or "best": the planner of preset "recommended" chooses.

    k0_rad_per_mm, order : what is left of a wave of k rad/mm is exp(-(k / k0)^order)
    depth_um             : mean depth that comes off; if more than 0 and there is a tool, the tool works by contact and
                           takes nothing off where it does not reach; otherwise all is levelled, as by a film
    minutes              : of work on the whole lens; the planner of "recommended" chooses them if they are left out
    pad_mm               : size of the tool, which follows longer waves; more than 500 mm: no tool
    witness              : marks beside the lens that show when to stop, if a hand does the work and the margin has room
    """

    process: Annotated[
        str,
        Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=40),
        shown(
            "Finished by hand",
            choices=_PROCESSES,
            card="main",
            wide=True,
        ),
    ] = NONE
    k0_rad_per_mm: Annotated[
        Annotated[float, Field(ge=LEAST_K0_RAD_PER_MM, le=1000)] | None,
        shown(
            "Levels from",
            "What is left of a wave of k rad/mm is exp(-(k / this)^order). The test piece measures yours.",
            usual="usual",
        ),
    ] = None
    order: Annotated[
        Annotated[float, Field(ge=ORDER_RANGE[0], le=ORDER_RANGE[1])] | None,
        shown("Order", "1 soft pad, 2 sanding, 4 a film that levels.", usual="usual"),
    ] = None
    depth_um: Annotated[
        Annotated[float, Field(ge=DEPTH_RANGE_UM[0], le=DEPTH_RANGE_UM[1]), none_or_from(0.001)] | None,
        shown("Comes off", usual="usual"),
    ] = None
    minutes: Annotated[
        Annotated[float, Field(ge=1e-4, le=100_000)] | None,
        shown(
            "Work",
            "On the whole lens. Empty: planned with “Recommended”, otherwise the usual time of the process.",
            usual="planned",
        ),
    ] = None
    pad_mm: Annotated[
        Annotated[float, Field(ge=LEAST_PAD_MM, le=5000)] | None,
        shown("Size of the tool", "Of the pad or block: it follows longer waves.", usual="usual"),
    ] = None

    witness: Annotated[
        bool,
        shown(
            "Witness marks",
            "A last program mills a few ripples beside the lens. Each disappears at a known minute of the finish.",
        ),
    ] = True

    @property
    def witnessed(self) -> bool:
        """Whether marks are wanted and a pad may do the work by hand, as far as known so far."""
        by_contact = self.process != NONE if self.depth_um is None else self.contact_depth_mm is not None
        return self.witness and self.finishes and by_contact

    @property
    def finishes(self) -> bool:
        """Whether anything is levelled, as far as known so far."""
        return self.process != NONE or self.k0_rad_per_mm is not None

    @property
    def contact_depth_mm(self) -> float | None:
        """Depth that a tool takes off by contact; None for a film, or if no depth is given."""
        has_tool = self.pad_mm is None or self.pad_mm <= LONGEST_PAD_MM
        return self.depth_um / 1000 if self.depth_um is not None and self.depth_um > 0 and has_tool else None


def find_processes(finish: FinishSpec) -> dict[str, Process]:
    """Find the library's processes that a spec may use; none if their name no longer exists."""
    name = finish.process
    if name == NONE:
        return {}
    processes = load_processes()
    if name == BEST:
        return processes
    return {name: processes[name]} if name in processes else {}


def resolve_finish(
    finish: FinishSpec, processes: Mapping[str, Process], *, area_mm2: float, to_be_planned: bool
) -> FinishSpec:
    """Fill in the known figures of the process; minutes and what follows from them stay open if they are planned.

    processes : of `find_processes`
    SpecError names the key, its value and what is allowed.
    """
    if finish.process == BEST:
        if not to_be_planned:
            words = Phrase(
                "'best' is chosen by the planner only; allowed: preset = 'recommended', or the name of a process"
            )
            raise SpecError([("finish.process", words)])
        return finish
    if finish.process == NONE:
        _require_own_figures(finish)
        return finish
    if finish.process not in processes:
        raise SpecError([("finish.process", unknown_name(finish.process, (*load_processes(), BEST)))])
    process = processes[finish.process]
    if finish.minutes is None and finish.k0_rad_per_mm is None:
        if to_be_planned:
            return finish
        finish = finish.model_copy(update={"minutes": _round_minutes(process.minutes(area_mm2))})
    return fill_figures(finish, process, area_mm2=area_mm2)


def fill_figures(finish: FinishSpec, process: Process, *, area_mm2: float) -> FinishSpec:
    """Fill in transfer function, depth and tool from the minutes, or the minutes from the transfer function."""
    minutes, k0 = finish.minutes, finish.k0_rad_per_mm
    if minutes is None:
        assert k0 is not None
        minutes = _round_minutes(process.minutes_to(k0, area_mm2))
    if k0 is None:
        k0 = round(process.k0_rad_per_mm(minutes, area_mm2), 4)
        if k0 < LEAST_K0_RAD_PER_MM:
            words = Phrase(
                "{minutes:g} level the whole lens away; allowed: at most {most:.3g} minutes on a lens of this size",
                minutes=minutes,
                most=process.minutes_to(LEAST_K0_RAD_PER_MM, area_mm2),
            )
            raise SpecError([("finish.minutes", words)])
    filled = {
        "k0_rad_per_mm": k0,
        "order": process.order if finish.order is None else finish.order,
        "minutes": minutes,
        "depth_um": round(process.depth_after_um(minutes, area_mm2), 2) if finish.depth_um is None else finish.depth_um,
        "pad_mm": min(process.pad_mm, 5000.0) if finish.pad_mm is None else finish.pad_mm,
    }
    return finish.model_copy(update=filled)


def _round_minutes(minutes: float) -> float:
    """Round to tenths; a lens of a few millimetres keeps its seconds."""
    return round(minutes, 1) if minutes >= 1.0 else float(f"{minutes:.3g}")


def _require_own_figures(finish: FinishSpec) -> None:
    """Require k0 and order together if there is no process, and no other figure alone."""
    if (finish.k0_rad_per_mm is None) != (finish.order is None):
        missing = "order" if finish.order is None else "k0_rad_per_mm"
        words = Phrase("is missing; allowed: k0_rad_per_mm and order together, or a process")
        raise SpecError([(f"finish.{missing}", words)])
    if finish.k0_rad_per_mm is None and (finish.minutes is not None or finish.depth_um is not None):
        given = "minutes" if finish.minutes is not None else "depth_um"
        words = Phrase("has no effect without a process; allowed: with finish.process, or k0_rad_per_mm and order")
        raise SpecError([(f"finish.{given}", words)])
