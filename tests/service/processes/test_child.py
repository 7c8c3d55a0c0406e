"""Whatever a child process of ours does, who asks gets an answer or an error with a name, and nobody is left."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from phrases.phrase import phrases_in
from service.errors import FailedError, InputError, PictureError, ServiceError, SpecError
from service.processes.child import Child, ChildCrashed, ChildDied, ChildLate
from service.processes.child_work import WordPipe
from service.processes.kept_child import KeptChild
from tests.service.server.worker.stage_bench import lives
from tests.waiting import PATIENCE_S, until

ODD = "tests.service.processes.odd_child"
ROOT = Path(__file__).parents[3]

ASK_AND_WAIT = f"""
import sys
from service.processes.child import Child
child = Child({ODD!r})
print(*child.ask({{"do": "have a family", "max_pixels": 0}})["pids"], flush=True)
child.ask({{"do": "sleep", "max_pixels": 0}})
"""


@pytest.fixture
def child() -> Iterator[Child]:
    made = Child(ODD)
    yield made
    made.end()


def ask(child: Child, do: str, **more: Any) -> dict[str, Any]:
    return child.ask({"do": do, "max_pixels": 0, **more})


def test_results_shares_and_phrases_arrive_one_request_after_the_other(child: Child) -> None:
    shares: list[float] = []
    request = {"do": "echo", "say": ["ü", 1.5], "max_pixels": 0}
    for _ in range(2):
        found = child.ask(request, on_share=shares.append)
        assert found == {"said": ["ü", 1.5], "phrase": "a lens"}
        assert phrases_in(found) == {"a lens": {"template": "a {what}", "values": {"what": "lens"}}}
    assert set(shares) == {0.5}


def test_one_that_swallows_its_signal_ends_with_its_input(child: Child) -> None:
    ask(child, "swallow SIGTERM")
    with ThreadPoolExecutor() as pool:
        ended = pool.submit(child.end, signal.SIGTERM)
        try:
            ended.result(PATIENCE_S)
        finally:
            child.kill()


@pytest.mark.parametrize(
    ("kind", "args", "expected"),
    [
        ("InputError", ["too thin", "too\nwide"], InputError("too thin", "too?wide")),
        ("PictureError", ["black"], PictureError("black")),
        ("SpecError", [[["stock.x_mm", "far"]], {"stock.x_mm": 3}], SpecError([("stock.x_mm", "far")], {"stock.x_mm": 3})),  # noqa: E501
        ("FailedError", ["no lens"], FailedError("no lens")),
    ],
)  # fmt: skip
def test_what_its_work_raises_is_raised_here(child: Child, kind: str, args: list[Any], expected: ServiceError) -> None:
    with pytest.raises(type(expected)) as raised:
        ask(child, "raise", kind=kind, args=args)
    assert raised.value.lines == expected.lines
    assert getattr(raised.value, "use", {}) == getattr(expected, "use", {})


@pytest.mark.parametrize(("do", "words"), [("break", "IndexError: 7"), ("eat", "MemoryError: ")])
def test_a_fault_of_its_work_is_said_and_the_next_request_is_answered(child: Child, do: str, words: str) -> None:
    with pytest.raises(ChildCrashed, match=words):
        ask(child, do)
    assert ask(child, "echo", say=1)["said"] == 1


@pytest.mark.parametrize(
    ("do", "words"), [("die", "signal 11"), ("close the pipe", "signal 9")]
)  # who hears nothing more of a process ends it
def test_a_process_that_says_nothing_more_is_one_that_died(child: Child, do: str, words: str) -> None:
    with pytest.raises(ChildDied, match=words):
        ask(child, do, by="SIGSEGV")


def test_what_is_no_word_is_passed_over(child: Child) -> None:
    assert ask(child, "garbage") == {}


def test_late_is_late(child: Child) -> None:
    child.await_ready(60.0)
    with pytest.raises(ChildLate):
        child.ask({"do": "sleep", "max_pixels": 0}, within_s=0.05)


def test_its_end_is_that_of_its_whole_group(child: Child) -> None:
    pids = ask(child, "have a family")["pids"]
    child.end()
    until(lambda: not any(map(lives, pids)))


def test_who_waits_learns_that_another_thread_killed_it(child: Child) -> None:
    child.await_ready(60.0)
    with ThreadPoolExecutor(1) as pool:
        asking = pool.submit(ask, child, "sleep")
        child.kill()
        with pytest.raises(ChildDied):
            asking.result()


def test_of_many_callers_at_once_each_gets_the_answer_to_its_own_question() -> None:
    kept = KeptChild(ODD, answer_s=20.0)
    with ThreadPoolExecutor(16) as pool:
        requests = [(f"caller {n}", {"do": "echo", "say": n, "max_pixels": 0}) for n in range(200)]
        answers = list(pool.map(lambda one: kept.ask(*one).result(60), requests))
    kept.close()
    assert [one["said"] for one in answers] == list(range(200))


def test_it_ends_with_a_killed_asker_even_at_work() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    asker = subprocess.Popen([sys.executable, "-c", ASK_AND_WAIT], env=environment, stdout=subprocess.PIPE, text=True)
    assert asker.stdout is not None
    pid, of_its_family = map(int, asker.stdout.readline().split())
    asker.kill()
    asker.communicate()
    until(lambda: not lives(pid))
    os.kill(of_its_family, 9)  # nobody is left who knows of it


def test_progress_is_dropped_while_the_pipe_is_full_and_the_last_word_waits() -> None:
    """The child's side alone: a worker that reads nothing for minutes."""
    pipe, its_end = os.pipe()
    words = WordPipe(its_end)
    os.set_blocking(its_end, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(its_end, b"\n" * 4096)
    words.send_share(0.5)
    with ThreadPoolExecutor(1) as pool:
        last = pool.submit(words.send, {"result": "x" * 200_000})
        with os.fdopen(pipe, "rb") as file:
            lines = iter(file.readline, b"")
            assert next(line for line in lines if line != b"\n") == b'{"result": "' + b"x" * 200_000 + b'"}\n'
        last.result()
    os.close(its_end)
