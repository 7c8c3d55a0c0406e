"""The process that estimates jobs. One JSON line in, one out.

In: {"path", "name", "max_pixels", "spec"}. Out: {"estimate": {...}}, {"refused": [lines], "kind"} or {"fault": text};
first of all {"ready": true}.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

from service.kernel_cache import use_current_kernels

use_current_kernels()  # before numba is imported

from service.errors import JobError, PictureError  # noqa: E402
from service.estimate import estimate  # noqa: E402
from service.picture_limits import PictureLimits  # noqa: E402
from service.spec_files import validated  # noqa: E402
from service.worker.linux import address_space_bytes, die_with_parent, name_process  # noqa: E402

_BESIDE_BYTES = 1_500_000_000  # kernels, arrays of a lens of 200 vertices, threads
_BYTES_PER_PIXEL = 16


def main() -> None:
    """Argument: the process to die with."""
    if sys.platform == "linux":
        die_with_parent(int(sys.argv[1]))
        name_process("cm-estimates")
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    base = address_space_bytes() if sys.platform == "linux" else 0
    _say(answers, {"ready": True})
    for line in sys.stdin:
        asked = json.loads(line)
        _limit(base + _BESIDE_BYTES + _BYTES_PER_PIXEL * asked["max_pixels"])
        _say(answers, _answer(asked))


def _answer(asked: dict[str, Any]) -> dict[str, Any]:
    limits = PictureLimits(max_pixels=asked["max_pixels"])
    try:
        return {"estimate": estimate(validated(asked["spec"]), Path(asked["path"]), limits=limits, name=asked["name"])}
    except PictureError as error:
        return {"refused": str(error).split("\n"), "kind": "picture"}
    except JobError as error:
        return {"refused": str(error).split("\n"), "kind": "input"}
    except Exception as error:  # the process that asked says so and goes on
        return {"fault": " ".join(f"{type(error).__name__}: {error}".split())[:500]}


def _limit(most: int) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _say(answers: Any, word: dict[str, Any]) -> None:
    answers.write(json.dumps(word, allow_nan=False) + "\n")
    answers.flush()


if __name__ == "__main__":
    main()
