"""A stage that is stopped is gone at once, with everything that it started."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.server.worker.stage_process import Done, Stopped
from tests.service.server.worker.stage_bench import PROMPT_S, Bench, lives, pids_in

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="stages run under Linux only")


@pytest.mark.parametrize("do", ["sleep", "hold_interpreter", "deaf", "family", "close_all"])
def test_a_cancelled_stage_is_gone_with_all_it_started(bench: Bench, do: str) -> None:
    """SIGTERM, and SIGKILL after 1 s to who is deaf to it (`family` has such members)."""
    end, seconds, pids = bench.stopped_when_told(do)
    assert end == Stopped("cancelled")
    assert not any(map(lives, pids))
    assert seconds < PROMPT_S


def test_a_stage_is_cancelled_in_the_middle_of_kernels_on_all_cores(computing: Bench) -> None:
    told = computing.folder / "ready"
    end = computing.run("spin_kernel", lambda: "cancelled" if told.exists() else None, tell=str(told))
    asked = told.stat().st_mtime
    assert end == Stopped("cancelled")
    assert time.time() - asked < PROMPT_S


def test_what_a_stage_leaves_behind_ends_with_it(bench: Bench, tmp_path: Path) -> None:
    told = tmp_path / "pids"
    assert bench.run("family", tell=str(told), leave=True) == Done({})
    assert not any(map(lives, pids_in(told)))


def test_a_stage_is_not_started_when_it_is_unwanted_already(bench: Bench, tmp_path: Path) -> None:
    assert bench.run("sleep", lambda: "fenced", tell=str(tmp_path / "pids")) == Stopped("fenced")


def test_stages_of_several_slots_do_not_touch_one_another(bench: Bench) -> None:
    with ThreadPoolExecutor(4) as pool:
        working = pool.submit(bench.run, "echo", pause_s=0.4)
        stopped = [pool.submit(bench.stopped_when_told, do) for do in ("sleep", "hold_interpreter")]
        assert {future.result()[0] for future in stopped} == {Stopped("cancelled")}
        assert isinstance(working.result(), Done)
