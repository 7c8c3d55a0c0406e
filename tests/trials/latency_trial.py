"""How long a hold takes from the HTTP call to the wire while the agent streams.

The simulated mill runs on a pty at factor 1, the agent in a process of its own. Taken is the time from just before the
POST to the moment the mill's end of the pty has read the `!`; bytes that were written earlier lie before it in the
pty, as they would in a UART (at most the 128 that the controller's buffer takes: 11 ms at 115200).
"""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from machines.simulated import SimulatedMill
from machines.simulated.endpoints import serve_pty
from tests.benchmarks.timing import Figure
from tests.service.milling.agent.process import AgentProcess, memory_mb
from tests.service.mills import AT_ZERO
from tests.trials.live import usage

_LINES = 400_000


def figures(holds: int) -> Iterator[Figure]:
    """Hold and resume so often; the latencies, and what the agent needs meanwhile."""
    mill, wire_s, lines = SimulatedMill(AT_ZERO), [0.0], [0]
    received = mill.receive

    def receive(data: bytes, at_s: float | None = None) -> None:
        lines[0] += data.count(b"\n")
        if b"!" in data:
            wire_s[0] = time.perf_counter()
        received(data, at_s)

    mill.receive = receive  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder, serve_pty(mill, 1.0) as endpoint:
        path = Path(folder) / "short.nc"
        moves = "\n".join(f"G1X{(i % 2000) / 1000 + 0.001:.4f}Y{i % 7 / 1000:.4f}" for i in range(_LINES))
        path.write_text(f"G21 G90 G17 G94\nG54\nM3 S1000\nF1200\n{moves}\nM5\nM2\n")
        with AgentProcess(Path(folder) / "data", endpoint.url) as agent:
            agent.until(lambda status: status["status"]["state"] == "idle")
            run = agent.post("/v1/runs", 201, program=agent.upload(path), name="latency")["id"]
            agent.post(f"/v1/runs/{run}:start", 202, operator="trial", checks=["tool", "zero", "stock", "clear"])
            chance, took_s = random.Random(3), []
            begun_s, cpu_s, sent = time.perf_counter(), usage(agent.process.pid)[0], lines[0]
            for _ in range(holds):
                agent.until(lambda status: status["status"]["state"] == "run")
                time.sleep(0.2 + 0.3 * chance.random())
                wire_s[0], call_s = 0.0, time.perf_counter()
                agent.post("/v1/control/hold", 202)
                while not wire_s[0]:
                    time.sleep(0.0005)
                took_s.append(wire_s[0] - call_s)
                agent.until(lambda status: status["status"]["state"] == "held")
                agent.post("/v1/control/resume", 202)
            time_s, rate = time.perf_counter() - begun_s, lines[0] - sent
            cpu_share = (usage(agent.process.pid)[0] - cpu_s) / time_s
            yield Figure(
                "agent: resident memory while streaming",
                memory_mb(agent.process.pid),
                "MB",
                f"{rate / time_s:.0f} lines/s",
            )
            yield Figure("agent: processor share, polled and held all the time", 100 * cpu_share, "% of a core")
            took_s.sort()
            for share in (0.5, 0.99, 1.0):
                took_ms = 1000 * took_s[min(holds - 1, int(share * holds))]
                yield Figure(
                    f"`!` from API call to wire, p{100 * share:g} of {holds}", took_ms, "ms", "allowed: p99 20 ms"
                )
