"""A child process that is asked in lines of JSON, for work that the process that serves must not do itself.

`LineChild` is the side that asks; `answer_lines` the side that answers, under limits, and dies with whoever asks.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

from phrases.phrase import phrases_in, restore
from service.errors import FailedError, PictureError, ServiceError, SpecError
from service.processes.linux import address_space_bytes, die_with_parent, name_process
from service.processes.priority import give_way
from service.processes.source_tree import python_path

_LOOK_S = 0.1
_PIECE_BYTES, _ANSWER_BYTES = 1 << 20, 1 << 23


class ChildDied(Exception):
    """The child ended instead of answering."""


class ChildLate(Exception):
    """The child did not answer in time."""


class LineChild:
    """A process of ours, started with this one's number. It says a line first, then answers each line with one.

    It dies with the *thread* that started it: let that one live as long as it.
    """

    def __init__(self, module: str, given_up: Callable[[], bool] = lambda: False, *, start_s: float = 20.0) -> None:
        """Start it. given_up: true once nobody wants it any more. ChildDied, ChildLate or OSError where it does not
        start.
        """
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # decoders print what a stranger's file makes them print
            env={**os.environ, "PYTHONPATH": python_path()},
            start_new_session=True,
            bufsize=0,
        )
        try:
            self._await_start(given_up, start_s)
        except BaseException:
            self.end()
            raise

    def _await_start(self, given_up: Callable[[], bool], start_s: float) -> None:
        """Wait for the start, long on a busy computer: a server that ends meanwhile does not wait for it."""
        assert self._process.stdout is not None
        until = time.monotonic() + start_s
        while not select.select([self._process.stdout], [], [], _LOOK_S)[0]:
            if given_up() or time.monotonic() > until:
                raise ChildLate
        self._answer(start_s)

    def ask(self, asked: dict[str, Any], within_s: float) -> dict[str, Any]:
        """Return its answer; ChildDied, or ChildLate after so many seconds."""
        assert self._process.stdin is not None
        text = json.dumps(asked).encode() + b"\n"
        while text:
            text = text[self._process.stdin.write(text) :]
        return self._answer(within_s)

    @property
    def pid(self) -> int:
        return self._process.pid

    def kill(self) -> None:
        """Kill it from any thread: whoever waits for its answer gets ChildDied."""
        self._process.kill()

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        for end in (self._process.stdin, self._process.stdout):
            if end is not None:
                end.close()

    def _answer(self, within_s: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        until, text = time.monotonic() + within_s, b""
        while not text.endswith(b"\n"):
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, until - time.monotonic()))
            if not ready:
                raise ChildLate
            piece = os.read(self._process.stdout.fileno(), _PIECE_BYTES)
            if not piece or len(text) > _ANSWER_BYTES:
                raise ChildDied
            text += piece
        try:
            found: dict[str, Any] = json.loads(text)
            phrases = found.pop("phrases", {})
        except ValueError:
            raise ChildDied from None
        return {key: restore(value, phrases) for key, value in found.items()}


def answer_lines(
    name: str,
    answer: Callable[[dict[str, Any]], dict[str, Any]],
    *,
    beside_bytes: int,
    bytes_per_pixel: int,
    barred: Iterable[int] = (resource.RLIMIT_CORE,),
) -> None:
    """Answer until the input ends. argv: the process to die with.

    beside_bytes, bytes_per_pixel : address space beyond what it starts with: always, and by `max_pixels` of the ask
    barred                        : resources of which it gets nothing
    """
    if sys.platform == "linux":
        die_with_parent(int(sys.argv[1]))
        name_process(name)
    give_way()
    for kind in barred:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(kind, (0, 0))
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    base = address_space_bytes() if sys.platform == "linux" else 0
    _say(answers, {"ready": True})
    for line in sys.stdin:
        asked = json.loads(line)
        _limit_memory(base + beside_bytes + bytes_per_pixel * asked["max_pixels"])
        _say(answers, answer(asked))


def answer_or_refuse(answer: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what `answer` gives; in its place {"refused", "kind"} for what people can mend, {"fault"} for all else."""
    try:
        return answer()
    except PictureError as error:
        return {"refused": error.lines, "kind": "picture"}
    except FailedError as error:
        return {"refused": error.lines, "kind": "failed"}
    except OSError as error:
        return {"refused": str(error).split("\n"), "kind": "failed"}
    except SpecError as error:
        return {"refused": error.lines, "kind": "input", "problems": error.problems, "use": error.use}
    except ServiceError as error:
        return {"refused": error.lines, "kind": "input"}
    except Exception as error:  # the process that asked says so and goes on
        return {"fault": " ".join(f"{type(error).__name__}: {error}".split())[:500]}


def _limit_memory(most: int) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _say(answers: Any, word: dict[str, Any]) -> None:
    answers.write(json.dumps({**word, "phrases": phrases_in(word)}, allow_nan=False) + "\n")
    answers.flush()
