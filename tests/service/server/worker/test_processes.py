"""A stage's process ends in one named way, whatever the stage does."""

from __future__ import annotations

import gc
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from phrases.phrase import phrases_in
from service.processes.linux import own_children
from service.server.worker.stage_process import Crashed, Done, Failed, Refused, StageEnd, StageProcesses
from service.settings import ServerSettings
from tests.service.server.worker.stage_bench import Bench, fork_server_pid, lives, pids_in
from tests.waiting import until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="stages run under Linux only")


def test_a_stage_s_result_progress_and_words_arrive(bench: Bench) -> None:
    end = bench.run("echo", say=["ü", 1.5], pause_s=0.15)
    assert isinstance(end, Done)
    assert end.result["said"] == ["ü", 1.5]
    assert bench.shares == sorted(bench.shares) and len(bench.shares) >= 3
    assert bench.log.read_text() == "said on stdout\nsaid on stderr\n"


def test_a_stage_has_no_files_of_others_open(bench: Bench) -> None:
    """stdin, stdout, stderr, words, beats, and the listing itself: nothing that would keep a pipe of another open."""
    with ThreadPoolExecutor(4) as pool:
        ends = list(pool.map(lambda _: bench.run("echo", pause_s=0.05), range(8)))
    assert {len(end.result["open"]) for end in ends if isinstance(end, Done)} == {6}
    assert len(ends) == 8


@pytest.mark.parametrize(
    ("kind", "args", "expected"),
    [
        ("InputError", ["too thin", "too\nwide"], Refused(("too thin", "too?wide"))),
        ("PictureError", ["black"], Refused(("black",), "image")),
        ("SpecError", [[["stock.x_mm", "too far"]]], Refused(("stock.x_mm: too far",), "spec.stock.x_mm")),
        ("FailedError", ["no lens"], Failed(("no lens",))),
        ("OSError", [28, "No space left on device", "/x"], Failed(("cannot use /x: no space left on the disk",))),
        ("ValueError", ["a bug"], Crashed("ValueError: a bug")),
        ("SystemExit", [3], Crashed("SystemExit: 3")),
    ],
)  # fmt: skip
def test_an_error_in_a_stage_has_its_name(bench: Bench, kind: str, args: list[Any], expected: StageEnd) -> None:
    assert bench.run("raise_error", kind=kind, args=args) == expected
    assert ("Traceback" in bench.log.read_text()) == isinstance(expected, Crashed | Failed) or kind == "FailedError"


def test_what_a_stage_refuses_can_be_said_in_another_language(bench: Bench) -> None:
    end = bench.run("refuse_far", how="too far")
    assert isinstance(end, Refused)
    (line,) = end.lines
    far = {"template": "is {how}", "values": {"how": "too far"}}
    told = {"template": "{key}: {sentence}", "values": {"key": "stock.x_mm", "sentence": far}}
    assert phrases_in(end.lines) == {line: told}


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL, signal.SIGABRT, signal.SIGTERM])
def test_a_signal_is_a_crash_and_the_next_stage_works(bench: Bench, number: signal.Signals) -> None:
    end = bench.run("die", signal=number)
    assert isinstance(end, Crashed) and number.name in end.words
    assert isinstance(bench.run("echo"), Done)


def test_an_exit_without_a_result_is_a_crash(bench: Bench) -> None:
    assert bench.run("leave", code=0) == Crashed("the stage's process ended with code 0 and without a result")


@pytest.mark.parametrize("hunger", ["bomb", "no_threads"])
def test_too_much_memory_is_a_sentence(bench: Bench, hunger: str) -> None:
    end = bench.run(hunger)
    assert isinstance(end, Failed) and "out of memory: a stage may take 600 MB" in end.lines[0]


def test_a_stage_that_takes_too_long_is_a_sentence(bench: Bench, tmp_path: Path) -> None:
    bench.processes.close()
    bench = Bench(tmp_path, stage_time_s=1.0)
    end = bench.run("sleep", tell=str(tmp_path / "pids"))
    assert end == Failed(("the stage took longer than 1 s (CAUSTICMILL_STAGE_TIME_S)",))
    assert not lives(pids_in(tmp_path / "pids")[0])
    bench.processes.close()


def test_garbage_on_the_pipe_is_passed_over(bench: Bench) -> None:
    assert bench.run("garbage") == Done({"after": "garbage"})


def test_much_progress_neither_blocks_nor_piles_up(bench: Bench) -> None:
    """A worker that is slow to listen does not slow the stage; a long result comes whole."""
    end = bench.processes.run(
        {"do": "chatter", "times": 300_000, "bytes": 5_000_000},
        log=bench.log, on_progress=lambda _: time.sleep(0.1), stop=lambda: None,
    )  # fmt: skip
    assert isinstance(end, Done) and len(end.result["long"]) == 5_000_000


@pytest.mark.thorough
def test_a_log_is_cut_in_its_middle(bench: Bench) -> None:
    """100 MB said, of which never much is on the disk; what was said first and last is there, and where it was cut."""
    taken: list[int] = []

    def stop() -> None:
        taken.append(bench.log.stat().st_blocks * 512)

    bench.log.touch()
    assert bench.run("chat", stop, lines=1_000_000) == Done({})
    assert max(taken) < 50_000_000
    text = bench.log.read_text()
    assert len(text) < 1_000_200
    assert text.startswith("the first line\n") and text.endswith("the last line\n")
    assert "cut here" in text


def test_an_error_of_the_worker_leaves_no_process(bench: Bench, tmp_path: Path) -> None:
    def stop() -> str | None:
        if (tmp_path / "pids").exists():
            raise RuntimeError("database gone")
        return None

    with pytest.raises(RuntimeError):
        bench.run("sleep", stop, tell=str(tmp_path / "pids"))
    assert not lives(pids_in(tmp_path / "pids")[0])


def test_a_child_of_the_warm_fork_server_computes_with_threads_and_solvers(computing: Bench) -> None:
    """Twice the same bits: nothing depends on what the process before left behind."""
    first, second = (computing.run("compute") for _ in range(2))
    assert isinstance(first, Done)
    assert first.result["strips"]
    assert first.result["sum_error"] < 1e-6 and first.result["solve_error"] < 1e-9
    assert first == second


@pytest.mark.thorough
def test_the_fork_server_has_one_thread_when_it_forks(computing: Bench) -> None:
    """With everything imported that the real stages need, too."""
    computing.run("compute")
    assert len(list(Path(f"/proc/{fork_server_pid()}/task").iterdir())) == 1
    computing.processes.close()
    real = StageProcesses(ServerSettings.load(data=computing.folder))
    real.warm()
    end = real.run({"stage": "none"}, log=computing.log, on_progress=lambda _: None, stop=lambda: None)
    assert isinstance(end, Crashed)  # no such order; but the fork server is warm
    until(lambda: real._link.begin().threads)
    assert real._link.begin().threads == 1
    real.close()


@pytest.mark.thorough
def test_a_hundred_stages_leave_no_file_and_no_process(bench: Bench) -> None:
    bench.run("echo")
    gc.collect()  # what earlier tests left behind would go at a moment of its own
    before = len(list(Path("/proc/self/fd").iterdir())), threading.active_count()
    fork_server, children = fork_server_pid(), set(own_children())
    its_files = len(list(Path(f"/proc/{fork_server}/fd").iterdir()))
    for number in range(100):
        assert isinstance(bench.run("echo", say=number), Done)
    assert len(list(Path("/proc/self/fd").iterdir())) <= before[0]
    assert threading.active_count() <= before[1]
    assert len(list(Path(f"/proc/{fork_server}/fd").iterdir())) <= its_files
    assert set(own_children()) == children
