"""Laws of the life of a run."""

from __future__ import annotations

import pytest

from machines.errors import NotAllowedError
from machines.mill.run import Run
from machines.runs import LIVE, RECOVER_CHECKS, START_CHECKS, TRANSITIONS, Confirmation, RunReport, RunState, move_state


def test_every_state_is_in_the_table_and_reachable_from_parked() -> None:
    assert set(TRANSITIONS) == set(RunState)
    seen = {RunState.PARKED}
    while more := {after for state in seen for after in TRANSITIONS[state]} - seen:
        seen |= more
    assert seen == set(RunState)


def test_only_a_person_brings_a_run_to_life() -> None:
    """The ways into a live state from outside are start (from parked) and recover (from interrupted, aborted)."""
    ways = {(before, after) for before in RunState if before not in LIVE for after in TRANSITIONS[before] & LIVE}
    assert ways == {
        (RunState.PARKED, RunState.RUNNING),
        (RunState.INTERRUPTED, RunState.RECOVERING),
        (RunState.ABORTED, RunState.RECOVERING),
    }


def test_every_live_state_can_be_interrupted() -> None:
    assert all(RunState.INTERRUPTED in TRANSITIONS[state] for state in LIVE)


@pytest.mark.parametrize("before", RunState)
@pytest.mark.parametrize("after", RunState)
def test_moves_follow_the_table(before: RunState, after: RunState) -> None:
    if after in TRANSITIONS[before]:
        assert move_state(before, after) is after
    else:
        with pytest.raises(NotAllowedError, match=f"{before.value}.*{after.value}"):
            move_state(before, after)


@pytest.mark.parametrize("missing", sorted(RECOVER_CHECKS))
def test_a_missing_check_is_named(missing: str) -> None:
    with pytest.raises(NotAllowedError, match=f"confirmation of: {missing}$"):
        Confirmation("ann", RECOVER_CHECKS - {missing}).demand(RECOVER_CHECKS, "recover")
    Confirmation("ann", START_CHECKS).demand(START_CHECKS, "start")


def test_nobody_confirms_nothing() -> None:
    with pytest.raises(NotAllowedError, match="name"):
        Confirmation("  ", START_CHECKS).demand(START_CHECKS, "start")


@pytest.mark.parametrize(
    ("times", "share"), [({}, 0.25), ({"time_s": 100.0, "cut_s": 80.0}, 0.8), ({"time_s": 9.0, "cut_s": 10.0}, 1.0)]
)
def test_share_is_by_time_or_by_lines_and_one_at_the_end(times: dict[str, float], share: float) -> None:
    about = {"id": "a", "name": "n", "program": "p", "path": "/p", "lines": 200, "executed_line": 50} | times
    view = RunReport(state=RunState.RUNNING, **about)
    assert view.share == share
    assert view.as_dict()["state"] == "running"
    assert RunReport(state=RunState.FINISHED, **about).share == 1.0


def test_a_journal_of_before_there_were_codes_is_told_by_its_words() -> None:
    record = {"id": "a", "state": "interrupted", "words": "port lost", "warnings": ["X would go"]}
    view = Run(record, lambda: pytest.fail("no journal"), lambda: pytest.fail("no facts")).view
    assert (view.words, view.code, view.values, view.travel_in_doubt) == ("port lost", "", {}, False)
