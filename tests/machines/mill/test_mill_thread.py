"""The owner thread: calls and their exceptions come back, waiting readers wake, and it never leaves a mill cutting."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from machines.driver import MillState
from machines.errors import NotAllowedError
from machines.mill.thread import MillThread
from machines.runs import START_CHECKS, Confirmation, RunState
from tests.trials.kill_bench import Bench
from tests.trials.kill_program import facts_of

YES = Confirmation("ann", START_CHECKS)
LINES = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 Z5", "G0 X10 Y10", "G1 Z-1 F200"]
LINES += [f"G1 X{10 + 100 * (i % 2)} F100" for i in range(1, 400)] + ["G0 Z5", "M5", "M2"]


@pytest.fixture
def thread(tmp_path: Path) -> Iterator[MillThread]:
    path = tmp_path / "p.nc"
    path.write_text("\n".join(LINES) + "\n")
    bench = Bench(tmp_path / "mill", random.Random(1), homing=False, hal=False)
    bench.until_state(MillState.IDLE)
    facts = facts_of(path)
    made = MillThread(bench.mill)
    made.start()
    made.call(lambda mill: mill.park(facts, path, "part"))
    yield made
    made.stop(detach=True)


def begun(thread: MillThread) -> str:
    run = thread.snapshot.run
    assert run is not None
    thread.call(lambda mill: mill.start(run.id, YES))
    waited(thread, MillState.RUN)
    return run.id


def waited(thread: MillThread, state: MillState) -> None:
    for _ in range(10_000):
        snapshot = thread.snapshot
        if snapshot.status.state is state:
            return
        thread.wait_for_change(snapshot.version, 5.0)
    raise AssertionError(f"never {state}: {thread.snapshot.status}")


def test_results_and_exceptions_come_back(thread: MillThread) -> None:
    assert thread.call(lambda mill: mill.name) == "sim"
    with pytest.raises(NotAllowedError, match="no such run"):
        thread.call(lambda mill: mill.start("nothing", YES))
    with pytest.raises(ZeroDivisionError):
        thread.call(lambda mill: 1 // 0)
    assert thread.call(lambda mill: threading.current_thread().name) == "mill sim"


def test_a_call_is_seen_in_the_snapshot_when_it_returns(thread: MillThread) -> None:
    run_id = begun(thread)
    thread.call(lambda mill: mill.hold())
    assert thread.snapshot.run is not None and thread.snapshot.run.id == run_id
    assert thread.snapshot.run.state in (RunState.HOLDING, RunState.HELD)


def test_a_moving_mill_is_not_left_by_accident(thread: MillThread) -> None:
    begun(thread)
    with pytest.raises(NotAllowedError, match="hold it"):
        thread.stop()
    thread.call(lambda mill: mill.hold())
    waited(thread, MillState.HELD)
    thread.stop()
    with pytest.raises(NotAllowedError, match="not running"):
        thread.call(lambda mill: mill.name)


def test_it_may_be_left_when_that_is_said(thread: MillThread) -> None:
    begun(thread)
    thread.stop(detach=True)


def test_a_failure_of_the_owner_holds_the_mill(thread: MillThread) -> None:
    begun(thread)
    mill = thread.call(lambda mill: mill)

    def fails(_timeout_s: float) -> None:
        raise RuntimeError("a bug")

    thread.call(lambda mill: setattr(mill, "step", fails))
    for _ in range(100):
        if "a bug" in str([entry.words for entry in thread.snapshot.events]):
            break
        thread.wait_for_change(thread.snapshot.version, 0.1)
    assert any("a bug" in entry.words for entry in mill.snapshot.events)
    with pytest.raises(NotAllowedError, match="a bug"):
        thread.call(lambda mill: mill.name)
