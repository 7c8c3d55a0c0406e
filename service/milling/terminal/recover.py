"""`stream --recover`: the way on with an interrupted run, in words and blocks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from machines.mill.thread import MillThread
from machines.preflight.preflight import Preflight
from machines.recovery.plan_model import Need, RecoveryPlan
from machines.runs import RECOVERABLE, RunView
from service.errors import FailedError, InputError
from service.milling.terminal.leaving import Buffers
from service.milling.terminal.printing import print_lines
from service.milling.terminal.ready import meet_needs


def find_interrupted_run(thread: MillThread, facts: Preflight, program: Path) -> RunView:
    """Find the latest run of this very program that did not come to its end."""
    runs = [run for run in thread.snapshot.runs if run.program == facts.sha256 and run.state in RECOVERABLE]
    if not runs:
        raise InputError(
            f"no interrupted run of {program.name}, as it is now, is known for this mill; start it without --recover"
        )
    return max(runs, key=lambda run: run.created_s)


def prepare_plan(thread: MillThread, buffers: Buffers, run: RunView, *, person: bool, vouched: bool) -> RecoveryPlan:
    """Return the plan, once all that must come first is done; FailedError names what is not.

    person : somebody is at the terminal and can be asked     vouched : --confirm-position was given
    """
    plan: RecoveryPlan

    def needs() -> tuple[Need, ...]:
        nonlocal plan
        plan = thread.call(lambda mill: mill.plan_recovery(run.id))
        if plan.refusals:
            raise FailedError(*(f"this run cannot go on: {words}" for words in plan.refusals))
        return plan.needs

    meet_needs(thread, buffers, needs, zero_back=lambda: plan.zero_back, person=person, vouched=vouched)
    print_lines(plan_lines(plan, run))
    return plan


def plan_lines(plan: RecoveryPlan, run: RunView) -> Iterator[str]:
    """Yield the plan for a person to check."""
    yield f"recovery:   run {run.id}, {run.state.value}{f': {run.words}' if run.words else ''}"
    for words in plan.words:
        yield f"            {words}"
    for words in plan.differences:
        yield f"offset:     {words}"
    for number, block in enumerate(plan.blocks):
        yield f"{'way in:' if number == 0 else '':<11} {block}"
    yield f"{'then:':<11} line {plan.overlap_line:,} and on; {plan.recut_lines} of them for the second time"
