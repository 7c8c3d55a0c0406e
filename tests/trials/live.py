"""The streaming process itself, in real time over a pty: processor time, memory, first motion."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from machines.simulated import GRBL_11, SimulatedMill, Traits
from machines.simulated.endpoints import serve_pty
from tests.trials import programs

_TICKS = os.sysconf("SC_CLK_TCK")
# Motion faster than the wire, and a tool that stands at its zero.
FAST: Traits = replace(
    GRBL_11.with_settings({110: 30000, 111: 30000, 112: 30000, 120: 20000, 121: 20000, 122: 20000}),
    lines_per_s=4000.0,
    power_up_machine_mm=(-290.0, -290.0, -10.0),
)


@dataclass(frozen=True, slots=True)
class Sample:
    """The process at one time: since its start, lines the mill has received, processor seconds, resident megabytes."""

    at_s: float
    lines: int
    cpu_s: float
    rss_mb: float


def write_program(path: Path, cuts: int, *, line_bytes: int = 20) -> Path:
    """A program of so many cuts; every line `line_bytes` long with its end."""
    with path.open("wb") as file:
        held: list[bytes] = []
        for line in programs.lines(cuts, line_bytes=line_bytes):
            held.append(line.text)
            if len(held) == 50_000:
                file.write(b"\n".join(held) + b"\n")
                held.clear()
        file.write(b"\n".join(held) + b"\n")
    return path


def watch_stream(
    program: Path,
    state: Path,
    *,
    seconds: float,
    every_s: float = 1.0,
    enough: Callable[[list[Sample]], bool] | None = None,
) -> tuple[list[Sample], float]:
    """Run `causticmill stream` for so long; samples, and seconds from its start to the first motion."""
    mill = SimulatedMill(FAST)
    mill.recording.keep = False
    received = [0]
    first_motion_s = [0.0]
    plain = mill.receive

    def receive(data: bytes, at_s: float | None = None) -> None:
        received[0] += data.count(b"\n")
        plain(data, at_s)

    mill.receive = receive  # type: ignore[method-assign]
    with serve_pty(mill, 1.0) as endpoint, _streaming(program, endpoint.url, state) as process:
        began_s = time.monotonic()
        samples: list[Sample] = []
        next_s = every_s
        while (now_s := time.monotonic() - began_s) < seconds and process.poll() is None:
            if not first_motion_s[0] and mill.firmware.stepper.moving:
                first_motion_s[0] = now_s
            if now_s >= next_s:
                samples.append(Sample(now_s, received[0], *usage(process.pid)))
                next_s += every_s
                if enough is not None and enough(samples):
                    break
            time.sleep(0.01)
    return samples, first_motion_s[0]


@contextlib.contextmanager
def _streaming(program: Path, url: str, state: Path) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "service.cli.main", "stream", str(program), "--port", url, "--yes"]
    with (state / "stream.log").open("wb") as log:
        process = subprocess.Popen(command, env={**os.environ, "XDG_STATE_HOME": str(state)}, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()
            process.wait()


def usage(pid: int) -> tuple[float, float]:
    """Processor seconds and resident megabytes of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return (int(fields[11]) + int(fields[12])) / _TICKS, pages * os.sysconf("SC_PAGESIZE") / 1e6
