"""Figures of a plan for report.json: the choice and the other candidates."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from cam.planning.planner import Candidate
from service.job.files import plain
from service.job.planning.plan import Planned
from service.job.planning.sentences import blur_warning, blur_warnings, candidate_words, hopeful_db, reasons


def plan_figures(planned: Planned) -> dict[str, Any]:
    """Return the choice and the other candidates for report.json, each with the values that select it."""
    chosen = planned.chosen
    return plain(
        {
            **_figures(planned, chosen),
            **planned.settings(),
            "contact_share": planned.light.contact_share,
            "psnr_db_unfinished": None if planned.unfinished is None else planned.unfinished.chosen.psnr_db,
            "goal": {key: value for key, value in asdict(planned.goal).items() if value is not None},
            "goal_met": planned.plan.met,
            "perfect_psnr_db": planned.light.perfect_db(chosen.marks.smallest_mm),
            "best_psnr_db": planned.plan.best.psnr_db,
            "hopeful_db": hopeful_db(planned),
            "chosen": planned.plan.front.index(chosen),
            "candidates": [_line(planned, one) for one in planned.plan.front],
            "left_out": [{"tool": name, "why": why} for name, why in planned.plan.left_out],
            "why": reasons(planned),
            "warnings": blur_warnings(planned),
        }
    )


def _rest(planned: Planned, one: Candidate) -> dict[str, Any] | None:
    """Return the figures of the rest pass, which mills the valleys that the finishing ball leaves filled."""
    if one.rest is None:
        return None
    lens = planned.light.forms[one.finish.radius_mm]
    return {
        "tool": one.rest.tool.name,
        "radius_mm": one.rest.spec.radius_mm,
        "pitch_mm": one.rest.spec.pitch_mm,
        "area_mm2": one.rest.extent.area_mm2,
        "area_share": one.rest.extent.area_mm2 / (lens.width_mm * lens.height_mm),
        "length_mm": one.rest.extent.length_mm,
        "regions": one.rest.extent.regions,
        "hours": one.rest.extent.seconds / 3600,
        "gain_db": planned.rest_gain_db(one),
    }


def _figures(planned: Planned, one: Candidate) -> dict[str, Any]:
    return {
        "hours": one.hours,
        "hours_by_pass": [seconds / 3600 for seconds in one.seconds],
        "psnr_db": one.psnr_db,
        "seen_db": planned.score(one).seen_db,
        "ssim": planned.score(one).ssim,
        "blur_mm": one.blur_mm,
        "blur_px": planned.blur_px(one),
        "rest": _rest(planned, one),
    }


def _line(planned: Planned, one: Candidate) -> dict[str, Any]:
    finish = one.finish
    return {
        **_figures(planned, one),
        "tool": one.tool.name,
        "radius_mm": finish.radius_mm,
        "pitch_mm": finish.pitch_mm,
        "direction": finish.direction,
        "strategy": finish.strategy,
        "words": candidate_words(one),
        "warning": blur_warning(planned, one),
        "spec": planned.fragment(one),
    }
