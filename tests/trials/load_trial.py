"""A computer with fifty things to do, and the job server started anew in the middle of a run: the mill mills on."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.stops.conditions import LOOPS, busy_computer
from tests.benchmarks.timing import Figure
from tests.disturbances.floor import running_floor

LINES = 1500  # a hundred seconds of the mill's time
_BEFORE_S, _AFTER_S = 10.0, 5.0


def figures(*, lines: int = LINES, killed: bool = False) -> Iterator[Figure]:
    """killed: the server ends by kill -9, and not when it is told to."""
    how = "killed" if killed else "ended"
    name = f"{LOOPS} busy loops, server {how} and started in the middle of a run"
    with tempfile.TemporaryDirectory() as folder, running_floor(Path(folder), lines=lines) as floor:
        floor.start()
        with busy_computer():
            time.sleep(_BEFORE_S)
            begun_s, before = time.monotonic(), floor.mill.cut
            floor.restart_server(killed=killed)
            took_s, meanwhile = time.monotonic() - begun_s, floor.mill.cut - before
            state = str(floor.at_agent()["state"])
            time.sleep(_AFTER_S)
            load = os.getloadavg()[0]
        ended, verdict = floor.until_ended(), floor.verdict()
    broken = [] if ended["state"] == "finished" else [f"the run is {ended['state']}: {ended['words']}"]
    broken += [] if verdict.clean and not verdict.recut else [f"cut is not the program: {verdict}"[:300]]
    broken += [f"{len(floor.mill.holds)} feed holds"] if floor.mill.holds else []
    words = f"load {load:.0f}; {state} when the server was back"
    yield Figure(f"{name}: cuts meanwhile", meanwhile, "cuts", f"BROKEN: {broken}" if broken else words)
    yield Figure(f"{name}: until it is ready", took_s, "s")
