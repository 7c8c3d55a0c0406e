"""`stream --recover`: the way on with an interrupted run, in words and blocks, and what must be done before.

Nothing here moves the mill except a homing cycle that the person asks for.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

from machines.driver import Command, Home, TrustPosition, Unlock
from machines.gcode.preflight import Preflight
from machines.mill.mill import Mill
from machines.mill.thread import MillThread
from machines.recovery.planning import Need, RecoveryPlan
from machines.runs import RECOVERABLE, RunView
from service.errors import FailedError, InputError
from service.stream.words import print_lines

_SOON_S = 10.0
_HOMING_S = 300.0
_STEP_S = 0.2


def interrupted_run(thread: MillThread, facts: Preflight, program: Path) -> RunView:
    """The latest run of this very program that did not come to its end."""
    runs = [run for run in thread.snapshot.runs if run.program == facts.sha256 and run.state in RECOVERABLE]
    if not runs:
        raise InputError(
            f"no interrupted run of {program.name}, as it is now, is known for this mill; start it without --recover"
        )
    return max(runs, key=lambda run: run.created_s)


def ready_plan(thread: MillThread, run: RunView, *, person: bool, vouched: bool) -> RecoveryPlan:
    """The plan, once all that must come first is done; FailedError names what is not.

    person : somebody is at the terminal and can be asked     vouched : --confirm-position was given
    """
    plan = thread.call(lambda mill: mill.plan_recovery(run.id))
    done: set[str] = set()
    while not plan.ready:
        if plan.refusals:
            raise FailedError(*(f"this run cannot go on: {words}" for words in plan.refusals))
        need = plan.needs[0]
        if need.code in done:
            raise FailedError(f"first: {need.words}")
        done.add(need.code)
        print_lines([f"first:      {need.words}"])
        plan = _met(thread, run, need, person=person, vouched=vouched)
    print_lines(plan_lines(plan, run))
    return plan


def plan_lines(plan: RecoveryPlan, run: RunView) -> Iterator[str]:
    """The plan for a person to check."""
    yield f"recovery:   run {run.id}, {run.state.value}{f': {run.words}' if run.words else ''}"
    for words in plan.words:
        yield f"            {words}"
    for words in plan.differences:
        yield f"offset:     {words}"
    for number, block in enumerate(plan.blocks):
        yield f"{'way in:' if number == 0 else '':<11} {block}"
    yield f"{'then:':<11} line {plan.overlap_line:,} and on; {plan.recut_lines} of them for the second time"


def _met(thread: MillThread, run: RunView, need: Need, *, person: bool, vouched: bool) -> RecoveryPlan:
    """Do what the need asks for, if that can be done from here; the plan afterwards."""
    if need.code == "connect":
        return _until_gone(thread, run, need, _SOON_S)
    if need.code == "stand still":
        thread.call(Mill.abort)
        return _until_gone(thread, run, need, _SOON_S)
    command = _chosen(need, person=person, vouched=vouched)
    thread.call(lambda mill: mill.command(command))
    return _until_gone(thread, run, need, _HOMING_S if isinstance(command, Home) else _SOON_S)


def _chosen(need: Need, *, person: bool, vouched: bool) -> Command:
    """Which command meets a lost position or a lock: the person's word, never a guess."""
    if need.code not in ("unlock", "position"):
        raise FailedError(f"first: {need.words}")
    if vouched:
        return Unlock() if need.code == "unlock" else TrustPosition()
    if not person:
        raise FailedError(f"first: {need.words}")
    other = "u unlock" if need.code == "unlock" else "t trust: you know that it is right"
    print(f"h home the mill (it MOVES)   {other}   anything else: stop here > ", end="", flush=True)
    answer = sys.stdin.readline().strip().lower()
    if answer == "h":
        return Home()
    if answer == other[0]:
        return Unlock() if need.code == "unlock" else TrustPosition()
    raise InputError(f"not done ({need.code}); the mill was not moved")


def _until_gone(thread: MillThread, run: RunView, need: Need, wait_s: float) -> RecoveryPlan:
    give_up_s = time.monotonic() + wait_s
    while True:
        plan = thread.call(lambda mill: mill.plan_recovery(run.id))
        if plan.refusals or all(other.code != need.code for other in plan.needs) or time.monotonic() > give_up_s:
            return plan
        thread.wait_for_change(thread.snapshot.version, _STEP_S)
