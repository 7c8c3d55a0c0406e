"""A child process that does odd things: what the request names."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from phrases.phrase import Phrase
from service import errors
from service.processes.child_work import answer_requests


def main() -> None:
    answer_requests("cm-odd", _work, beside_bytes=500_000_000)


def _work(asked: dict[str, Any], on_share: Callable[[float], None]) -> dict[str, Any]:
    match asked["do"]:
        case "echo":
            on_share(0.5)
            return {"said": asked["say"], "phrase": Phrase("a {what}", what="lens")}
        case "raise":
            raise getattr(errors, asked["kind"])(*asked["args"])
        case "break":
            raise IndexError("7")
        case "eat":
            return {"long": len(bytearray(4_000_000_000))}
        case "garbage":
            os.write(1, b"not a word\n[1]\n\xff{}\n")  # as a library that prints
            print("more of it", flush=True)
            return {}
        case "die":
            os.kill(os.getpid(), signal.Signals[asked["by"]])
        case "close the pipe":
            os.closerange(1, 100)
        case "swallow SIGTERM":
            signal.signal(signal.SIGTERM, lambda *_: None)
            return {}
        case "have a family":
            family = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
            return {"pids": [os.getpid(), family.pid]}
    while True:
        time.sleep(1)


if __name__ == "__main__":
    main()
