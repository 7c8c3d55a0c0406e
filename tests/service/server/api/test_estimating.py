"""Who asks gets the newest answer, from a process that is there only while it is wanted."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from service.errors import PictureError
from service.http.problems import Problem
from service.processes.kernel_cache import ESTIMATES, ready_mark
from service.server.api.intake.child_requests import Estimator
from tests.service.server.api.server import callers_of
from tests.waiting import PATIENCE_S, until

STUB = "tests.service.server.api.estimating_stub"


@pytest.fixture
def estimator() -> Iterator[Estimator]:
    with closing(Estimator(module=STUB)) as running:
        yield running


def ask(estimator: Estimator, name: str, caller: str = "ann") -> Any:
    return estimator.ask(caller, {"name": name})


def refusal(answer: Any) -> Problem:
    error = answer.exception(PATIENCE_S)
    assert isinstance(error, Problem)
    return error


def test_nothing_runs_before_it_is_asked_for(estimator: Estimator) -> None:
    assert estimator.child_pid is None
    assert ask(estimator, "a").result(PATIENCE_S) == {"name": "a"}
    assert estimator.child_pid is not None


def test_the_newest_ask_of_a_caller_wins(estimator: Estimator) -> None:
    """The one that is worked on and the one that waits are both ended at once."""
    running = ask(estimator, "takes 0.3")
    waiting = ask(estimator, "b")
    newest = ask(estimator, "c")
    assert [refusal(one).status for one in (running, waiting)] == [409, 409]
    assert newest.result(PATIENCE_S) == {"name": "c"}


def test_callers_do_not_end_each_other_s(estimator: Estimator) -> None:
    answers = [ask(estimator, f"of {caller}", caller) for caller in ("ann", "bob", "eve")]
    assert [answer.result(PATIENCE_S)["name"] for answer in answers] == ["of ann", "of bob", "of eve"]


def test_what_is_made_ready_ends_nobody_s_estimate(
    estimator: Estimator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    answer = ask(estimator, "takes 0.3")
    estimator.prepare()
    assert answer.result(PATIENCE_S) == {"name": "takes 0.3"}


def test_it_is_made_ready_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with closing(Estimator(module=STUB)) as estimator:
        estimator.prepare()
        until(lambda: estimator.child_pid is not None)
    ready_mark(ESTIMATES).touch()
    with closing(Estimator(module=STUB)) as estimator:
        estimator.prepare()
        assert not callers_of(estimator)


def test_too_many_callers_are_told_to_come_back(estimator: Estimator) -> None:
    ask(estimator, "takes 1", "first")
    until(lambda: estimator.child_pid is not None)
    with pytest.raises(Problem) as refused:
        for number in range(20):
            ask(estimator, "x", str(number))
    assert refused.value.status == 503
    assert "Retry-After" in refused.value.headers


def test_a_process_that_ends_costs_one_answer(estimator: Estimator) -> None:
    assert refusal(ask(estimator, "dies")).status == 503
    assert ask(estimator, "a").result(PATIENCE_S) == {"name": "a"}


def test_what_the_process_refuses_is_the_person_s_and_what_it_breaks_is_ours(estimator: Estimator) -> None:
    with pytest.raises(PictureError, match="too dark"):
        ask(estimator, "refused").result(PATIENCE_S)
    assert refusal(ask(estimator, "fault")).status == 500


def test_an_idle_process_is_ended_and_the_next_ask_starts_another() -> None:
    with closing(Estimator(module=STUB, idle_s=0.1)) as estimator:
        ask(estimator, "a").result(PATIENCE_S)
        first = estimator.child_pid
        until(lambda: estimator.child_pid is None)
        assert not Path(f"/proc/{first}").exists()
        assert ask(estimator, "b").result(PATIENCE_S) == {"name": "b"}


def test_the_end_of_the_server_ends_it_even_at_work() -> None:
    estimator = Estimator(module=STUB)
    answer = ask(estimator, "takes 600")
    until(lambda: estimator.child_pid is not None)
    estimator.close()
    assert refusal(answer).status == 503
    assert estimator.child_pid is None
    with pytest.raises(Problem):
        ask(estimator, "a")
    assert not [pid for pid in os.listdir("/proc") if _is_stub(pid)]  # noqa: PTH208


def _is_stub(pid: str) -> bool:
    """A process of this one that runs the stub."""
    try:
        line = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    return STUB.encode() in line and str(os.getpid()).encode() in line


@pytest.mark.parametrize("is_started", [True, False])
def test_what_takes_long_is_not_worked_on_when_nobody_waits_for_it(estimator: Estimator, is_started: bool) -> None:
    """Whoever asks next does not wait for it, whether the process was there already or only began."""
    if is_started:
        ask(estimator, "a").result(PATIENCE_S)
    left = estimator.ask("ann", {"name": "takes 600"}, is_long=True)
    other = ask(estimator, "of bob", "bob")
    if is_started:
        until(lambda: callers_of(estimator) == {"ann", "bob"})
    estimator.leave("ann")
    assert refusal(left).status == 409
    assert other.result(PATIENCE_S) == {"name": "of bob"}
    over = estimator.ask("ann", {"name": "takes 601"}, is_long=True)
    newer = estimator.ask("ann", {"name": "b"}, is_long=True)
    assert refusal(over).status == 409
    assert newer.result(PATIENCE_S) == {"name": "b"}


def test_who_asks_for_the_same_once_more_joins_the_first_ask(estimator: Estimator) -> None:
    first = estimator.ask("ann", {"name": "takes 0.3"}, is_long=True)
    assert estimator.ask("ann", {"name": "takes 0.3"}, is_long=True) is first
    assert first.result(PATIENCE_S) == {"name": "takes 0.3"}
