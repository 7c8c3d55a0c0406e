"""The other side of `line_child`: a process that answers lines of JSON under limits, and dies with whoever asks."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import sys
from collections.abc import Callable, Iterable
from typing import Any

from service.errors import FailedError, PictureError, ServiceError, SpecError
from service.processes.linux import address_space_bytes, die_with_parent, name_process
from service.processes.priority import give_way


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
        return {"refused": str(error).split("\n"), "kind": "picture"}
    except (FailedError, OSError) as error:
        return {"refused": str(error).split("\n"), "kind": "failed"}
    except SpecError as error:
        refused = {"refused": str(error).split("\n"), "kind": "input"}
        return refused | {"problems": error.problems, "use": error.use}
    except ServiceError as error:
        return {"refused": str(error).split("\n"), "kind": "input"}
    except Exception as error:  # the process that asked says so and goes on
        return {"fault": " ".join(f"{type(error).__name__}: {error}".split())[:500]}


def _limit_memory(most: int) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _say(answers: Any, word: dict[str, Any]) -> None:
    answers.write(json.dumps(word, allow_nan=False) + "\n")
    answers.flush()
