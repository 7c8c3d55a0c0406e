"""A simulated mill in a process of its own: `python -m tests.disturbances.mill`.

It says when each `!` arrives, by the clock that all processes share, and writes down what it cuts. Where it may, it has
a better priority than the computer's other work: no load takes a real mill's processor away.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from machines.simulated import CutSegment, Recording, SimulatedMill
from machines.simulated.endpoints import serve_pty
from tests.service.mills import AT_ZERO

_ROOT = Path(__file__).parents[2]
_NICE = -10


class MillProcess:
    """`holds`: when a feed hold arrived, seconds of time.monotonic."""

    def __init__(self, folder: Path, time_factor: float) -> None:
        self._record = folder / "cuts.jsonl"
        command = [sys.executable, "-m", "tests.disturbances.mill", str(self._record), str(time_factor)]
        self._process = subprocess.Popen(command, cwd=_ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.url = self._process.stdout.readline().strip()
        self.holds: list[float] = []
        self._arrived = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def hold_after(self, at_s: float, within_s: float) -> float | None:
        """When the first feed hold after `at_s` arrived; None where none does in time."""
        with self._arrived:
            self._arrived.wait_for(lambda: bool(self.holds) and self.holds[-1] >= at_s, within_s)
            return next((hold_s for hold_s in self.holds if hold_s >= at_s), None)

    def held(self, within_s: float = 20.0) -> bool:
        """Whether a feed hold has arrived. An answer to who asked for it may be here before what the mill says."""
        return self.hold_after(0.0, within_s) is not None

    @property
    def cut(self) -> int:
        """Pieces of program cut so far."""
        return len(self.cuts())

    def cuts(self) -> list[CutSegment]:
        """What was cut of programs so far, in order."""
        lines = self._record.read_text().splitlines() if self._record.exists() else []
        found = (CutSegment(*json.loads(line)) for line in lines if line.endswith("]"))
        return [
            one._replace(start=tuple(one.start), end=tuple(one.end))  # type: ignore[arg-type]
            for one in found
            if one.kind == "program" and not one.rapid
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(20)
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with self._arrived:
                self.holds.append(float(line))
                self._arrived.notify_all()


def main() -> None:
    """Arguments: the file for what is cut, and how much faster than a real mill. Ends with its stdin."""
    record, time_factor = Path(sys.argv[1]), float(sys.argv[2])
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    with record.open("w", buffering=1) as file:
        mill = SimulatedMill(AT_ZERO, recording=Recording(lambda cut: print(json.dumps(cut), file=file), keep=False))
        received = mill.receive

        def receive(data: bytes, at_s: float | None = None) -> None:
            for _ in range(data.count(b"!")):
                print(repr(time.monotonic()), flush=True)
            received(data, at_s)

        mill.receive = receive  # type: ignore[method-assign]
        with serve_pty(mill, time_factor) as endpoint:
            print(endpoint.url, flush=True)
            sys.stdin.read()


if __name__ == "__main__":
    main()
