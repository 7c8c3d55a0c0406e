"""A stage's process ends in one named way, with everything that it started, whatever happens to it or to its worker."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from service.settings import ServerSettings
from service.worker.linux import living_members, own_children
from service.worker.processes import Crashed, Done, Failed, Refused, StageEnd, StageProcesses, Stopped

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="stages run under Linux only")

HERE = Path(__file__).parent
ROOT = HERE.parents[2]


class Bench:
    """StageProcesses with the odd stages, and what a test wants to know about them."""

    def __init__(self, folder: Path, entry: str = "odd_stages:run", **settings: Any) -> None:
        given = {"data": folder, "lease_s": 2.0, "stage_memory_mb": 600, **settings}
        self.folder = folder
        self.log = folder / "stage.log"
        self.processes = StageProcesses(ServerSettings.load(**given), entry=entry)
        self.shares: list[float] = []

    def run(self, do: str, stop: Callable[[], str | None] = lambda: None, **order: Any) -> StageEnd:
        return self.processes.run({"do": do, **order}, log=self.log, on_progress=self.shares.append, stop=stop)

    def stopped_when_told(self, do: str, reason: str = "cancelled", **order: Any) -> tuple[StageEnd, float, list[int]]:
        """Stop a stage as soon as it has told its process numbers: the end, the seconds that took, the numbers."""
        told = self.folder / f"pids-{threading.get_ident()}"
        told.unlink(missing_ok=True)
        asked: list[float] = []

        def stop() -> str | None:
            if told.exists():
                asked.append(time.monotonic())
                return reason
            return None

        end = self.run(do, stop, tell=str(told), **order)
        return end, time.monotonic() - asked[0], pids_in(told)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("PYTHONPATH", str(HERE / "entries"))
    made = Bench(tmp_path)
    yield made
    made.processes.close()
    assert own_children() == []


@pytest.fixture
def computing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """With stages that compute, and room for the threads' own address space."""
    monkeypatch.setenv("PYTHONPATH", str(HERE / "entries"))
    made = Bench(tmp_path, "array_stages:run", stage_memory_mb=2000)
    yield made
    made.processes.close()
    assert own_children() == []


def pids_in(file: Path) -> list[int]:
    return [int(word) for word in file.read_text().split()]


def lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def until(what: Callable[[], object], within_s: float = 10.0) -> float:
    """Wait for it; the seconds that took."""
    begun = time.monotonic()
    while not what():
        assert time.monotonic() < begun + within_s, "it did not happen in time"
        time.sleep(0.005)
    return time.monotonic() - begun


def nursery_pid() -> int:
    (pid,) = (pid for pid in own_children() if b"service.worker.nursery" in Path(f"/proc/{pid}/cmdline").read_bytes())
    return pid


# --- how it ends ---------------------------------------------------------------------------------------------------


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


def test_an_error_of_the_worker_leaves_no_process(bench: Bench, tmp_path: Path) -> None:
    def stop() -> str | None:
        if (tmp_path / "pids").exists():
            raise RuntimeError("database gone")
        return None

    with pytest.raises(RuntimeError):
        bench.run("sleep", stop, tell=str(tmp_path / "pids"))
    assert not lives(pids_in(tmp_path / "pids")[0])


def test_a_child_of_the_warm_nursery_computes_with_threads_and_solvers(computing: Bench) -> None:
    """Twice the same bits: nothing depends on what the process before left behind."""
    first, second = (computing.run("compute") for _ in range(2))
    assert isinstance(first, Done)
    assert first.result["strips"]
    assert first.result["sum_error"] < 1e-6 and first.result["solve_error"] < 1e-9
    assert first == second


def test_the_nursery_has_one_thread_when_it_forks(computing: Bench) -> None:
    """With everything imported that the real stages need, too."""
    computing.run("compute")
    assert len(list(Path(f"/proc/{nursery_pid()}/task").iterdir())) == 1
    computing.processes.close()
    real = StageProcesses(ServerSettings.load(data=computing.folder))
    real.warm()
    end = real.run({"stage": "none"}, log=computing.log, on_progress=lambda _: None, stop=lambda: None)
    assert isinstance(end, Crashed)  # no such order; but the nursery is warm
    assert len(list(Path(f"/proc/{nursery_pid()}/task").iterdir())) == 1
    real.close()


# --- stopping it ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("do", "within_s"), [("sleep", 0.5), ("hold_interpreter", 0.5), ("deaf", 2.0), ("family", 2.0), ("close_all", 8.0)]
)
def test_a_cancelled_stage_is_gone_with_all_it_started(bench: Bench, do: str, within_s: float) -> None:
    """The bound: SIGTERM, and SIGKILL after 1 s to who is deaf to it (`family` has such members)."""
    end, seconds, pids = bench.stopped_when_told(do)
    assert end == Stopped("cancelled")
    assert not any(map(lives, pids))
    assert seconds < within_s


def test_a_stage_is_cancelled_in_the_middle_of_kernels_on_all_cores(computing: Bench) -> None:
    told = computing.folder / "ready"
    end = computing.run("spin_kernel", lambda: "cancelled" if told.exists() else None, tell=str(told))
    asked = told.stat().st_mtime
    assert end == Stopped("cancelled")
    assert time.time() - asked < 1.0


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


# --- deaths around it ----------------------------------------------------------------------------------------------


def a_worker(folder: Path, do: str, lease_s: float = 2.0) -> tuple[subprocess.Popen[str], list[int]]:
    """A real worker process whose stage runs; the worker, and the numbers that the stage told."""
    told = folder / "pids"
    order = json.dumps({"do": do, "tell": str(told)})
    worker = subprocess.Popen(
        [sys.executable, str(HERE / "worker_process.py"), str(folder), order, str(lease_s)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(HERE / "entries")])},
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    until(told.exists)
    return worker, pids_in(told)


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@pytest.mark.parametrize("do", ["sleep", "hold_interpreter", "family"])
def test_a_killed_worker_leaves_nothing(tmp_path: Path, do: str) -> None:
    worker, pids = a_worker(tmp_path, do)
    nursery = parent_of(pids[0])
    worker.kill()
    worker.communicate()
    assert until(lambda: not any(map(lives, [nursery, *pids])), 2.0) < 1.0


@pytest.mark.parametrize("do", ["sleep", "hold_interpreter", "family"])
def test_the_stage_of_a_frozen_worker_ends_by_itself(tmp_path: Path, do: str) -> None:
    worker, pids = a_worker(tmp_path, do, lease_s=2.0)
    worker.send_signal(signal.SIGSTOP)
    seconds = until(lambda: not any(map(lives, pids)), 3.0)
    assert seconds < 0.6 * 2.0 + 0.3
    worker.send_signal(signal.SIGCONT)
    said, _ = worker.communicate(timeout=10)
    assert said.strip() == str(Stopped("fenced"))


def test_the_stage_ends_by_itself_when_the_nursery_freezes_with_the_worker(tmp_path: Path) -> None:
    worker, pids = a_worker(tmp_path, "sleep", lease_s=2.0)
    nursery = parent_of(pids[0])
    for pid in (nursery, worker.pid):
        os.kill(pid, signal.SIGSTOP)
    until(lambda: not any(map(lives, pids)), 3.0)
    for pid in (nursery, worker.pid):
        os.kill(pid, signal.SIGKILL)
    worker.communicate()


@pytest.mark.parametrize("do", ["sleep", "family", "hold_interpreter"])
def test_a_killed_nursery_is_a_crash_and_the_next_stage_works(bench: Bench, do: str) -> None:
    told = bench.folder / "pids"
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(bench.run, do, tell=str(told))
        until(told.exists)
        os.kill(nursery_pid(), signal.SIGKILL)
        assert isinstance(future.result(timeout=10), Crashed)
    group, *_ = pids = pids_in(told)
    assert not living_members(group)
    assert isinstance(bench.run("echo"), Done)
    for pid in filter(lives, pids):  # the one that left the group has nobody any more who knows of it
        os.kill(pid, signal.SIGKILL)


def test_a_frozen_nursery_does_not_keep_a_stage_from_being_stopped(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.worker.supervision._BURIAL_S", 0.5)
    told = bench.folder / "pids"
    wanted: list[str] = []
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(bench.run, "sleep", lambda: wanted[0] if wanted else None, tell=str(told))
        until(told.exists)
        os.kill(nursery_pid(), signal.SIGSTOP)
        wanted.append("cancelled")
        assert future.result(timeout=15) == Stopped("cancelled")
    assert not lives(pids_in(told)[0])
    assert isinstance(bench.run("echo"), Done)


def test_a_worker_that_cannot_ask_whether_it_is_wanted_does_not_beat(bench: Bench) -> None:
    """stop() hangs as a database does: the stage ends itself, and the worker has to claim the job anew."""
    told = bench.folder / "pids"

    def stop() -> str | None:
        if told.exists():
            time.sleep(1.5)
        return None

    assert bench.run("sleep", stop, tell=str(told)) == Stopped("fenced")


def test_a_log_that_cannot_be_written_leaves_no_file_open(bench: Bench, tmp_path: Path) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(IsADirectoryError):
        bench.processes.run({}, log=tmp_path, on_progress=lambda _: None, stop=lambda: None)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_an_idle_nursery_ends_and_comes_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.worker.nursery_link._IDLE_S", 0.2)
    assert isinstance(bench.run("echo"), Done)
    until(lambda: own_children() == [])
    assert isinstance(bench.run("echo"), Done)


def test_a_nursery_that_cannot_start_is_a_crash_in_words(bench: Bench, tmp_path: Path) -> None:
    processes = StageProcesses(ServerSettings.load(data=tmp_path), entry="no_such_module:run")
    end = processes.run({}, log=bench.log, on_progress=lambda _: None, stop=lambda: None)
    assert isinstance(end, Crashed) and "could not be started" in end.words
    processes.close()


def test_a_hundred_stages_leave_no_file_and_no_process(bench: Bench) -> None:
    bench.run("echo")
    before = len(list(Path("/proc/self/fd").iterdir())), threading.active_count()
    nursery = nursery_pid()
    its_files = len(list(Path(f"/proc/{nursery}/fd").iterdir()))
    for number in range(100):
        assert isinstance(bench.run("echo", say=number), Done)
    assert (len(list(Path("/proc/self/fd").iterdir())), threading.active_count()) == before
    assert len(list(Path(f"/proc/{nursery}/fd").iterdir())) == its_files
    assert own_children() == [nursery_pid()] == [nursery]
