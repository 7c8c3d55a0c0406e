"""The REST views of runs and machines; the programs of a job, and the set-up before each."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from machines.profile import MachineProfile
from machines.runs import RECOVER_CHECKS, START_CHECKS
from phrases.phrase import Phrase
from service.http.problems import Problem
from service.http.schema import phrase_views
from service.job.files import list_programs, program_order
from service.milling.api import Check
from service.server.database.job_rows import sort_programs
from service.server.database.records import ABORTED, INTERRUPTED, PARKED, Artifact, Job
from service.server.database.runs import RunRow
from service.server.fleet.agent_replies import Json, make_mill_view, parse_holder, phrases_of, table
from service.server.fleet.registry import KnownMachine
from service.server.schemas.runs import AgentView, LiveRun, MachineView, OpenRun, PictureOfRun, ProgramOfRun, RunView
from service.wording import ball, shape_of

_SHAPES = {
    "ball": Phrase("ball end mill"),
    "flat": Phrase("flat end mill"),
    "bull-nose": Phrase("bull-nose end mill"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """One program of a job, or one part of a pass: number from 1 in the order of running, file name, hash, size.

    pass_number : of the pass, from 1; part: of it, from 1
    """

    number: int
    pass_number: int
    part: int
    name: str
    sha256: str
    bytes: int


def programs_of(files: Sequence[Artifact]) -> list[Program]:
    """Return the programs among a job's files, in the order in which they are run."""
    found = sort_programs(files)
    passes = [program_order(file.name)[0] for file in found]
    return [
        Program(
            number=number,
            pass_number=passes[number - 1],
            part=number - passes.index(passes[number - 1]),
            name=file.name,
            sha256=file.sha256,
            bytes=file.bytes,
        )
        for number, file in enumerate(found, 1)
    ]


def set_up(job: Job, number: int, part: int = 1) -> Json:
    """Return tool, block, zero and the changes since the program before, from the job's own spec and report.

    number : of the pass, as in the program's name; part: of it, from 1
    """
    rows = list_programs(job.spec, job.report or {})
    row: Json = next((row for row in rows if row["number"] == number), {})
    before: Json = next((row for row in reversed(rows) if row["number"] < number), {})
    tool = {"shape": _shape(row), "radius_mm": row.get("radius_mm"), "spindle_rpm": row.get("spindle_rpm")}
    optics, stock = table(job.spec, "optics"), table(job.spec, "stock")
    margin_mm = float(stock.get("margin_mm", 0.0))
    width_mm, height_mm, thickness_mm = optics.get("width_mm"), optics.get("height_mm"), stock.get("thickness_mm")
    block = {
        "width_mm": None if width_mm is None else width_mm + 2 * margin_mm,
        "height_mm": None if height_mm is None else height_mm + 2 * margin_mm,
        "thickness_mm": thickness_mm,
        "margin_mm": margin_mm,
        "material": stock.get("material"),
    }
    top = Phrase("the block's top")
    if not number:
        top = Phrase("{above_mm:g} mm below the raw top", above_mm=row.get("above_mm") or 0)
    zero = Phrase(
        "X0 Y0: front left corner of the lens, {margin_mm:g} mm from the block's left and front edges; Z0: {top}",
        margin_mm=margin_mm,
        top=top,
    )
    change = _same_pass(row) if part > 1 else _change(row, before) if before or number > 1 else None
    return {"tool": tool, "stock": block, "zero": zero, "change": change}


def _same_pass(row: Mapping[str, Any]) -> Json:
    """Return no change between two parts of one pass: any change would leave a mark where the second begins."""
    radius = row.get("radius_mm")
    words = Phrase(
        "the same tool as before, {tool}, and all zeros as they are: the pass goes on where it ended", tool=_tool(row)
    )
    return {"from_radius_mm": radius, "to_radius_mm": radius, "words": words}


def _change(row: Mapping[str, Any], before: Mapping[str, Any]) -> Json:
    """Return what to do between two passes. The work zero in X and Y stays; each tool has its own length."""
    old, new = before.get("radius_mm"), row.get("radius_mm")
    if old is not None and old == new and _shape(row) == _shape(before):
        words = Phrase("the same tool as before, {tool}: it stays in, and all zeros as they are", tool=_tool(row))
    else:
        words = Phrase(
            "change the tool from {old} to {new}, set Z zero again; X and Y zero stay",
            old=_tool(before),
            new=_tool(row),
        )
    return {"from_radius_mm": old, "to_radius_mm": new, "words": words}


def _shape(row: Mapping[str, Any]) -> str:
    shape = shape_of(row)
    return _SHAPES.get(shape, f"{shape} end mill")


def _tool(row: Mapping[str, Any]) -> str:
    """Return the size and, unless it is a ball, the shape."""
    shape, size = shape_of(row), "R ?" if row.get("radius_mm") is None else ball(row["radius_mm"])
    if shape == "bull-nose":
        return Phrase("bull-nose {size}, corner R {corner_mm:g} mm", size=size, corner_mm=row["corner_radius_mm"])
    return size if shape == "ball" else Phrase("flat {size}", size=size) if shape == "flat" else f"{shape} {size}"


ORDER: Check = "order"
CHECK_ORDER: tuple[Check, ...] = ("tool", "zero", "stock", "clear", "position", ORDER)
_ACTIONS = ("start", "hold", "resume", "abort", "recover")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """What a run is part of. job: None if it is gone; finished: hashes of programs that this mill has finished."""

    job: Job | None = None
    programs: Sequence[Program] = ()
    finished: frozenset[str] = frozenset()

    def list_left_out(self, number: int) -> list[Program]:
        """Return earlier passes that this mill has not finished."""
        return [one for one in self.programs if one.number < number and one.sha256 not in self.finished]

    def following(self, number: int) -> Program | None:
        return next((one for one in self.programs if one.number > number and one.sha256 not in self.finished), None)


def list_required_checks(run: RunRow, around: Surroundings) -> list[Check]:
    """Return the checks that a person has to confirm before the run may go on from here."""
    if run.state == PARKED and run.open:
        left_out = run.lift_mm is None and around.list_left_out(run.number)
        needed = START_CHECKS | ({ORDER} if left_out else frozenset())
    elif run.state in (INTERRUPTED, ABORTED) and run.agent_run is not None and has_started(run):
        needed = RECOVER_CHECKS
    else:
        return []
    return [check for check in CHECK_ORDER if check in needed]


def has_started(run: RunRow) -> bool:
    return bool(run.view and run.view.get("started_s"))


def make_run_view(run: RunRow, around: Surroundings) -> RunView:
    """Make a whole run."""
    passed = run.number if run.lift_mm is None else run.number - 1
    following, live, setup = around.following(passed), dict(make_live_run(run)), _set_up(around, run)
    return RunView(
        **live | {"phrases": live["phrases"] | phrase_views(setup)},
        job=run.job_id,
        job_name=around.job.name if around.job else "",
        program=ProgramOfRun(number=run.number, name=run.program, sha256=run.sha256),
        setup=setup,
        required_checks=list_required_checks(run, around),
        left_out=[ProgramOfRun.model_validate(one) for one in around.list_left_out(run.number)],
        next=None if following is None else ProgramOfRun.model_validate(following),
        created_by=run.created_by,
        created_at=run.created_at,
        links=_links(run),
    )


def _set_up(around: Surroundings, run: RunRow) -> Json | None:
    if around.job is None:
        return None
    for one in around.programs:
        if one.number == run.number:
            return set_up(around.job, one.pass_number, one.part)
    return set_up(around.job, run.number)


def _links(run: RunRow) -> dict[str, str]:
    here = f"/v1/runs/{run.id}"
    own = {"self": here, "events": f"{here}/events", "recovery": f"{here}/recovery", "timelapse": f"{here}/timelapse"}
    others = {"job": f"/v1/jobs/{run.job_id}", "machine": f"/v1/machines/{quote(run.machine, safe='')}"}
    return own | others | {action: f"{here}:{action}" for action in _ACTIONS}


def make_picture_view(run_id: str, at_s: int) -> PictureOfRun:
    return PictureOfRun(at=at_s, url=f"/v1/runs/{run_id}/timelapse/{at_s}.jpg")


def make_live_run(run: RunRow) -> LiveRun:
    """Make the part of a run that changes while it is on the mill."""
    view = run.view or {}
    return LiveRun(
        id=run.id,
        machine=run.machine,
        state=run.state,
        open=run.open,
        unreachable=run.away is not None,
        unreachable_words="" if run.away is None else run.away.detail,
        lift_mm=run.lift_mm,
        recoveries=view.get("recoveries", 0),
        warnings=view.get("warnings", []),
        travel_in_doubt=view.get("travel_in_doubt", False),
        started_at=view.get("started_s"),
        ended_at=run.ended_at,
        phrases=_phrases(run) | phrase_views(run.away and run.away.detail),
        **_why(run),
        **_how_far(view),
    )


def _why(run: RunRow) -> Json:
    reason = run.reason or {}
    return {"words": run.words or "", "code": reason.get("code", ""), "values": reason.get("values", {})}


def _phrases(run: RunRow) -> Json:
    """Return the phrases of the run's sentences, the agent's and our own."""
    return (phrases_of(run.view or {}) or {}) | (phrases_of(run.reason or {}) or {})


def _how_far(view: Json) -> Json:
    """Return the progress from the agent's report on a run."""
    nothing = {"share": 0.0, "executed_line": 0, "lines": None, "time_s": None, "time_left_s": None, "operator": ""}
    return {name: view.get(name, none) for name, none in nothing.items()}


def _agent(status: Json | None, away: Problem | None) -> AgentView:
    reachable = status is not None
    if away is None:
        return AgentView(reachable=reachable, words="", code="", values={}, phrases={})
    phrases = phrase_views((away.detail, away.values))
    return AgentView(reachable=reachable, words=away.detail, code=away.code, values=away.values, phrases=phrases)


def make_machine_view(
    machine: KnownMachine, status: Json | None, away: Problem | None, run: RunRow | None
) -> MachineView:
    """Make the view of a mill: its profile, whether its agent answers, its state, its open run, and who has control."""
    profile = machine.profile
    name = quote(machine.name, safe="")
    here = f"/v1/machines/{name}"
    shown = None if profile is None else _profile(profile)
    return MachineView(
        name=machine.name,
        remote=machine.remote,
        simulated=machine.simulated,
        problem=machine.problem,
        profile=shown,
        phrases=phrase_views((machine.problem, shown)),
        agent=_agent(status, away),
        mill=None if status is None else make_mill_view(status),
        run=None if run is None else _open_run(run),
        control=parse_holder(lease) if (lease := table(status or {}, "control")) else None,
        links={
            "self": here,
            "events": f"{here}/events",
            "control": f"{here}/control",
            "runs": f"/v1/runs?machine={name}",
        }
        | ({"camera": f"{here}/camera.jpg"} if machine.camera else {}),
    )


def _profile(profile: MachineProfile) -> Json:
    """Return the figures by which a person chooses a mill; its link concerns only the agent."""
    values = dataclasses.asdict(profile)
    names = (
        "description",
        "dialect",
        "travel_mm",
        "max_rate_mm_per_min",
        "step_mm",
        "spindle_rpm",
        "safe_z_mm",
        "homing",
        "spindle",
    )
    view: Json = {name: values[name] for name in names}
    view["spindle"] |= {"words": list(profile.spindle.sentences)}
    return view


def _open_run(run: RunRow) -> OpenRun:
    """Return the run's progress, shown with the mill."""
    return OpenRun(
        id=run.id,
        state=run.state,
        job=run.job_id,
        program=run.program,
        lift_mm=run.lift_mm,
        phrases=_phrases(run),
        **_why(run),
        **_how_far(run.view or {}),
    )
